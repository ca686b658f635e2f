"""Whole experiments over the public API; nothing else in the package knows of them."""
