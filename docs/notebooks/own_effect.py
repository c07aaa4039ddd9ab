# %% [markdown]
# # An effect of your own
#
# A vented box loses heat in proportion to its temperature difference times a fan's speed. No effect of the vocabulary says so. We
# declare it, without code, as a load on a derived channel, and see what calibration makes of it.

# %%
import numpy as np
import pandas as pd

import thermal_twin as tt
from twin_core.network.spec_io import load_spec

# %%
rng = np.random.default_rng(3)
time_s = 60.0 * np.arange(1200)
speed = np.where((time_s // 9000.0) % 2 == 0, 0.0, 1.0) * (0.5 + 0.5 * np.sin(time_s / 4000.0) ** 2)
temperature = [30.0]
for v in speed[:-1]:
    t = temperature[-1]
    for _ in range(12):
        t += 5.0 * (10.0 - 6.0 * v - 0.5 * (t - 20.0)) / 2500.0
    temperature.append(t)
bench = pd.DataFrame(
    {"T": np.array(temperature) + rng.normal(0.0, 0.02, time_s.size), "fan": speed, "room": 20.0, "Q": 10.0},
    index=time_s,
)


# %%
def declared(*loads):
    """Return the box, with further loads."""
    return load_spec(
        {
            "twin": "vented",
            "boundaries": {"room": {"channel": "room"}},
            "channels": {
                "T": {"kind": "temperature", "unit": "degC"},
                "room": {"kind": "temperature", "unit": "degC"},
                "Q": {"kind": "power", "unit": "W"},
                "fan": {"kind": "auxiliary"},
            },
            "derived": {"cooling": {"formula": "-1.0 * fan", "unit": "W"}},
            "nodes": [{"id": "box", "sensor": "T", "capacity_J_per_K": {"guess": 2000}}],
            "conductors": [{"between": ["box", "room"], "conductance_W_per_K": {"guess": 0.6}}],
            "loads": [{"channel": "Q", "node": "box"}, *loads],
        }
    )


without = tt.calibrate(declared(), bench)
with_fan = tt.calibrate(declared({"channel": "cooling", "node": "box", "gain": {"guess": 1.0}}), bench)
for name, model in (("without", without), ("with the fan", with_fan)):
    error = tt.simulate(model, bench)["box"] - bench["T"]
    print(f"{name}: rmse {np.sqrt((error**2).mean()):.3f} K")

# %% [markdown]
# It had been 6 W at full speed.

# %%
print(f"{with_fan.values['gain:cooling|box']:.2f} W")

# %% [markdown]
# What a formula cannot say, a law with unknowns in it, is a class of thirty lines: see
# [an effect of your own](../effects.md#an-effect-of-your-own). `twin check-effect` tests it.
