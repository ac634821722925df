"""The decoder for many pages at once, in a form that a GPU runs fast.

Every product has its constant on the right, since only then is it one call of the library whatever the number of pages:
`light @ constant`, or the transpose of the light, which is free. A complex number is a pair of reals within the axis
that is summed over. No place on a frame goes through a product, so products may be rounded; all behind the frames'
sampling may be computed in float16. What follows from the calibrated table alone is computed apart (`tables`), by
float64.
"""
