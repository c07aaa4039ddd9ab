# %% [markdown]
# # The first hour
#
# A box on a bench, two thermistors and a heater whose power is logged. The wall of the lab is known, the rest is guessed. We
# calibrate, let the loop look for what the model lacks, and forecast.

# %%
import numpy as np
import pandas as pd

import thermal_twin as tt
from twin_core.network.spec_io import load_spec

# %% [markdown]
# ## Telemetry
#
# Two days, one sample in five minutes. This is made up, so that we know what is in it: the box leaks 0.12 W/K to the wall, which
# we shall not declare.

# %%
rng = np.random.default_rng(7)
time = pd.date_range("2026-03-01", periods=576, freq="5min", tz="UTC")
heater_W = np.where((np.arange(576) // 40) % 3 == 0, 12.0, 0.0)
wall_degC = 20.0 + 1.5 * np.sin(2.0 * np.pi * np.arange(576) / 288.0)
box, lid = [20.0], [20.0]
for q, wall in zip(heater_W, wall_degC, strict=True):
    b, l = box[-1], lid[-1]
    for _ in range(30):  # steps of ten seconds
        into_box, into_lid = q + 0.8 * (l - b) + 0.12 * (wall - b), 0.8 * (b - l) + 0.25 * (wall - l)
        b, l = b + 10.0 * into_box / 4000.0, l + 10.0 * into_lid / 1500.0
    box.append(b)
    lid.append(l)
flight = pd.DataFrame(
    {
        "T_box": np.array(box[:-1]) + rng.normal(0.0, 0.03, 576),
        "T_lid": np.array(lid[:-1]) + rng.normal(0.0, 0.03, 576),
        "T_wall": wall_degC,
        "Q_heater": heater_W,
    },
    index=time,
)
flight.describe().loc[["mean", "min", "max"]].round(1)

# %% [markdown]
# ## What we believe

# %%
spec = load_spec(
    {
        "twin": "bench-box",
        "boundaries": {"wall": {"channel": "T_wall"}},
        "channels": {
            "T_box": {"kind": "temperature", "unit": "degC"},
            "T_lid": {"kind": "temperature", "unit": "degC"},
            "T_wall": {"kind": "temperature", "unit": "degC"},
            "Q_heater": {"kind": "power", "unit": "W"},
        },
        "nodes": [
            {"id": "box", "sensor": "T_box", "capacity_J_per_K": {"guess": 3000}},
            {"id": "lid", "sensor": "T_lid", "capacity_J_per_K": {"guess": 1000}},
        ],
        "conductors": [
            {"between": ["box", "lid"], "conductance_W_per_K": {"guess": 1.0}},
            {"between": ["lid", "wall"], "conductance_W_per_K": {"guess": 0.3}},
        ],
        "loads": [{"channel": "Q_heater", "node": "box"}],
    }
)
spec

# %% [markdown]
# The frame and the specification make a record: units become SI, what can be no reading is left out, and
# `telemetry.to_dataframe()` leads back.

# %%
telemetry = tt.Record.from_dataframe(flight, spec, name="bench")
telemetry

# %% [markdown]
# ## Close the loop
#
# The last 30 % of the record is kept back: no choice sees it.

# %%
loop = tt.close_loop(spec, telemetry, holdout=0.3)
loop

# %%
for finding in loop.report["findings"]:
    G = finding["parameters"].get("G_W_per_K", {})
    print(finding["effect"], finding["where"], f"{G['mean']:.3f} W/K" if G else "")

# %% [markdown]
# ## Use it

# %%
ahead = tt.forecast(loop.model, telemetry, "6h")
ahead["T_box"].iloc[[0, 35, -1]].round(2)
