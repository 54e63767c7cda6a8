"""How good a run is: rollouts, measures against the reference solver, pictures."""
