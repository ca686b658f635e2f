"""The evidence: pipelines and peers, the comparison, the paper's figures, and their pages."""
