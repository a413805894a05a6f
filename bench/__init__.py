"""Benchmarks: time, memory and safety of what the other rooms do. Each file is a command, or serves several."""
