"""The thermal twin's framework: physics, estimation and the closed loop.

Rooms, from the left (used by all) to the right (used by none):

- ``constants``, ``units``, ``errors``, ``_typing``: what everybody shares.
- ``parameters``: one parameter, its transform and prior; a named set as a flat vector.
- ``telemetry``: a record of times and channels.
- ``orbit``: where a spacecraft is, and what falls on its faces.
- ``network``: the declared thermal network, its heat balance as a sum of terms.
- ``gp``: kernels as state-space models, Kalman filter and smoother.
- ``fem``: the finite-element simulator of orbits.
- ``effects``: one missing-physics effect per file.
- ``simulate``: the rollout and its exact sensitivities.
- ``latent_force``: heat that nobody declared.
- ``calibrate``: fits the network to telemetry.
- ``closed_loop``, ``discover``, ``report``: the loop, what it believes and what it tells.
- ``forecast``, ``assimilate``: the future and the present.
"""

__version__ = "0.1.0"
