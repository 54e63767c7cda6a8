"""The three layers of the stress test: the energies, the reference solver, a trained run in autoregressive rollouts."""
