"""Inputs from files instead of the simulator: pose graphs (g2o) and recordings (mcap, rosbag2)."""
