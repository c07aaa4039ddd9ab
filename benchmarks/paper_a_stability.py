"""Section 5.7 of paper A: ten calibrations under independent noise, signal-to-noise ratio of every parameter."""

import numpy as np

from benchmarks.markdown import markdown_table
from benchmarks.paper_a_cases import noisy, simulations, training
from twin_core.calibrate.identifiability import IDENTIFIED_STD
from twin_core.calibrate.second_order import fit_trajectories
from twin_core.calibrate.summary import to_model
from twin_core.fem.paper import paper_spec

N_RUNS, NOISE = 10, 0.01


def stability() -> str:
    """Return SNR and predicted against empirical standard deviations over ten runs."""
    simulation = simulations()["combined", "A"]
    logs, stds = [], []
    names: tuple[str, ...] = ()
    for seed in range(N_RUNS):
        model = to_model(fit_trajectories(paper_spec(), [training(noisy(simulation, NOISE, seed))]), ())
        names = model.free_names
        logs.append(np.log([model.values[name] for name in names]))
        stds.append(np.sqrt(np.diag(model.covariance)))
        print(f"run {seed + 1} of {N_RUNS}", flush=True)
    values = np.exp(logs)
    snr = values.mean(axis=0) / values.std(axis=0, ddof=1)
    predicted, empirical = np.sqrt(np.mean(np.square(stds), axis=0)), np.std(logs, axis=0, ddof=1)
    identified = predicted < IDENTIFIED_STD
    ratio = predicted / empirical
    rows = [
        [n, f"{values[:, k].mean():.4g}", f"{snr[k]:.1f}", f"{predicted[k]:.3f}", f"{empirical[k]:.3f}", f"{ratio[k]:.2f}",
         "yes" if identified[k] else "no"]
        for k, n in enumerate(names)
    ]  # fmt: skip
    header = ["parameter", "mean", "SNR", "predicted std of ln", "empirical std of ln", "ratio", "identified"]
    pooled = float(np.sqrt(np.mean(np.square(predicted[identified])) / np.mean(np.square(empirical[identified]))))
    within = int(((ratio > 1 / 1.5) & (ratio < 1.5) & identified).sum())
    summary = (
        f"{int(identified.sum())} of {len(names)} parameters are identified (predicted relative standard deviation below a"
        f" third). Of these, {int((snr[identified] >= 3).sum())} have SNR of at least 3 over {N_RUNS} runs, the least"
        f" {snr[identified].min():.1f}. Of all {len(names)}, {int((snr >= 3).sum())} have (published: 31 of 37, the least"
        f" 1.1). Predicted over empirical standard deviation, pooled over the identified: {pooled:.2f};"
        f" {within} of {int(identified.sum())} within a factor 1.5 each (ten runs tell a standard deviation to 24 %)."
    )
    return summary + "\n\n" + markdown_table(header, rows)
