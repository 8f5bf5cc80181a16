"""Recordings: written as MCAP while a mission runs, read again, stepped again, fetched over a link, and shown."""
