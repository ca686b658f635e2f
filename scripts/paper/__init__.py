"""The paper's experiments, their pictures and a page of their numbers."""
