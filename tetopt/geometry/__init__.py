"""Closed forms on arrays of points and simplices; knows nothing of images."""
