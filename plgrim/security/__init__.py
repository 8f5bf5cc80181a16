"""Certificates, access control, and what a deployment may expose."""
