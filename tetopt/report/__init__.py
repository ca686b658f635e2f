"""Tables and pictures of results; knows nothing of how the numbers came to be."""
