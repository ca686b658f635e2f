"""Tables and pictures of results, independent of how the numbers were computed."""
