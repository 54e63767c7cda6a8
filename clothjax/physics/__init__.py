"""Energies of cloth, contact, a time step's potential, and two ways down it."""
