"""int32 symbols <-> payload bytes: integer frequency tables, priors, the ANS stream, and an LZMA mode."""

#: Sets of priors for a channel: all of them, or const and gauss alone, the model of R(a).
PRIORS = ("best", "gauss")
#: From the fastest encoding to the smallest payload.
EFFORTS = range(1, 10)
