"""Benchmarks of the other packages: time, memory and safety. Each file is a command or a helper of several commands."""
