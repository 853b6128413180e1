"""Picture metrics, the levels of a file as pictures and scores, and packing to a size; thresholds for keeping a level.

A level must gain something over the level below, measured as mPSNR on views that it was not trained on; 1 MB is 1e6
bytes.
"""

#: Encoding leaves out a layer whose level gains less per megabyte, dB. About 0.5 dB is what viewers begin to notice,
#: and half a megabyte takes 2 s at 2 Mbps, as long as a whole scene of this kind should.
ENCODE_MIN_DB_PER_MEGABYTE = 1.0
