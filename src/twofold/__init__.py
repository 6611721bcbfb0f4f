"""twofold: a video of a person goes in, an animatable 3D avatar comes out.

Implements *Representing Animatable Avatar via Factorized Neural Fields* (Song, Wu, Wandt, Sigal, Rhodin).
Lengths are metres, angles radians, colours 0..1; cameras follow OpenCV (x right, y down, z forward).
"""

__version__ = "0.1.0"
