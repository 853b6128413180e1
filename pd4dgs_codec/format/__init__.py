"""Whole scene <-> chunks of a `.pd4` file: layer plan, encoder, decoder, incremental stream. No torch."""
