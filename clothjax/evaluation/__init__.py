"""Evaluation of a run: rollouts, measures against the reference solver, pictures."""
