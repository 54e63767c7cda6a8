"""A trained garment in use: load, step, specialise. No training, no simulation."""
