"""One run on disk: its folder and files, checkpoints, lock, provenance, and signals that end it."""
