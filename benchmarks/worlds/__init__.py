"""A second world of finite elements for the closed loop: three-dimensional bodies, their contacts and what they hide.

Nothing of the product takes part in the truth: the elements are scikit-fem's, the heat balance, the orbits and the effects
are written here from the equations alone.
"""
