"""`python -m plgrim` is the command `plgrim`."""

from plgrim.cli import app

if __name__ == "__main__":
    app()
