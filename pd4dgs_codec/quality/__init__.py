"""Picture metrics, the levels of a file as pictures and scores, and packing to a size; thresholds for keeping a level.

A level must gain something over the level below, measured as mPSNR on views that it was not trained on; 1 MB is 1e6
bytes.
"""

#: Training drops level 1 or 2 if it gains less, dB. Held-back views lie between training views, which favours a level:
#: by 1.0 dB on a static scene after 1,500 steps and by 2.8 after 500, which cameras off the path do not confirm. In
#: dynamic scenes level 1 gains 2.0 dB and more over a level 0 at a key instant. Level 2 ends at a tenth to two thirds
#: of its gain on them, for a tenth to a fifth of the file, and without it the levels below gain more; docs/design.md
#: has the runs.
TRAIN_MIN_DB = {1: 1.5, 2: 0.6}
#: Training also drops a level that gains less per megabyte of its planes and networks, dB: other bytes gain more.
TRAIN_MIN_DB_PER_MEGABYTE = 4.0
#: Encoding leaves out a layer whose level gains less per megabyte, dB. About 0.5 dB is what viewers begin to notice,
#: and half a megabyte takes 2 s at 2 Mbps, as long as a whole scene of this kind should.
ENCODE_MIN_DB_PER_MEGABYTE = 1.0
