"""What every algorithm shares: configuration, networks, replay, random streams, trainer, evaluation, run folder."""
