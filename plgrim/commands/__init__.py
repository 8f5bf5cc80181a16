"""The commands, by what they are for; heavy imports stay inside them, so that each starts quickly."""
