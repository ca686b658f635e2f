"""Closed forms on arrays of points and simplices, independent of images."""
