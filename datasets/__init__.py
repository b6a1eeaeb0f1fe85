"""Data sets for development; nothing that is installed imports them."""
