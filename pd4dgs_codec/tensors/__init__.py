"""Tensors of three forms: their tables, their integers and their values, without their meaning and their bytes."""
