"""Stiff and extreme cases, each with what was fed, promised and found."""
