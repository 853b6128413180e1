"""Picture metrics, pictures and scores of a file's levels, packing to a size, and the threshold for keeping a layer."""

#: Encoding leaves out a layer whose level gains fewer dB of held-out mPSNR per megabyte (1e6 bytes) over the level
#: below. Viewers begin to notice about 0.5 dB, and half a megabyte takes 2 s at 2 Mbps, the intended time of a scene.
ENCODE_MIN_DB_PER_MEGABYTE = 1.0
