"""What the package needs of the machine: child processes within limits."""
