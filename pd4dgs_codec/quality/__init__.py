"""Picture metrics, pictures and scores of a file's levels, and packing to a size."""
