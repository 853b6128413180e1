"""From a trained scene to a file worth sending: target sizes, layers that pay, the trainer's own rate."""

#: Below this gain of a level its layer is left out: dB of mPSNR per megabyte (1e6 bytes). About 0.5 dB is what viewers
#: begin to notice, and half a megabyte takes 2 s at 2 Mbps, as long as all of such a scene should.
MIN_GAIN_PER_MEGABYTE = 1.0
