"""Hostile input for the decoder: seed files, mutations, and what must hold for every input. The command is fuzz.py."""
