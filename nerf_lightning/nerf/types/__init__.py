"""The nouns of the program: frozen structs of tensors with named axes.

Units: world axes as the user gave them (or a recorded similarity of them); a camera looks along -z of its own axes
(x right, y up, z back); pixel centers lie at +0.5, row 0 is on top; colors are sRGB-encoded in [0, 1].
`*rays` is any leading shape. Letters: `t` is the distance along a ray of unit direction.
"""
