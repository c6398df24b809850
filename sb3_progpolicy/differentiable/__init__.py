"""The program as a torch module: the mixture of all programs, W, and fast ways to run them on the CPU."""
