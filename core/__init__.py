"""Learning, and nothing else: agents, maps, networks, replay, random streams, the training loop, evaluation."""
