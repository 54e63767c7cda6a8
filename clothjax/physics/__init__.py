"""Energies of cloth, contact, the potential of a time step, and two ways to minimise it."""
