"""Files on disk: assets, configurations, checkpoints; checked when read."""
