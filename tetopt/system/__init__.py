"""What the package needs of the machine: processes, memory, files, untrusted input, compiled kernels."""
