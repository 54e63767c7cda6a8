"""Phi, Psi, their parts and the baselines: init and apply, no training."""
