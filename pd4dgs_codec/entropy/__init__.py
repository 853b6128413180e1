"""int32 symbols <-> payload bytes: integer frequency tables, priors, the ANS stream, and an LZMA mode."""

#: Priors that a channel may choose from: all of them, or const and gauss alone, the model of R(a).
PRIORS = ("best", "gauss")
#: From fast to small.
EFFORTS = range(1, 10)
