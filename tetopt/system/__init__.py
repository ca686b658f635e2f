"""The interface to the machine: processes, memory, files, untrusted input, compiled kernels."""
