"""What other commands than `tetopt mesh` do with a mesh's file."""
