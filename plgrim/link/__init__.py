"""The link between robot and base station: one process, on the robot (docs/link.md)."""
