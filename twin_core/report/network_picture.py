"""The thermal network as an SVG picture, with what was found drawn into it."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from twin_core._typing import FloatArray
from twin_core.report.phrasing import in_words, number

WIDTH, HEIGHT, MARGIN = 900.0, 400.0, 64.0
_LABEL_ROOM = 70.0
_LONGEST = 24
_EFFECT_BEND = -26.0
_STEPS = 400
_STRETCH = 1.6
_MOST_PLACES = 40
"""Nodes and boundaries beyond which arrows would only cover one another."""


def draw_network(network: Mapping[str, Any]) -> str:
    """Return the picture as an ``<svg>`` element whose colours come from the page's style sheet.

    Parameters
    ----------
    network
        ``nodes``, ``boundaries``, ``conductors`` [a, b, W/K], ``radiators`` [node, sink] and ``effects``.

    Returns
    -------
    str
        Empty where there are no nodes. Every name is escaped.
    """
    nodes, boundaries = list(network.get("nodes") or []), list(network.get("boundaries") or [])
    if not nodes:
        return ""
    conductors, radiators = network.get("conductors") or [], network.get("radiators") or []
    effects = network.get("effects") or []
    joined = [(c[0], c[1]) for c in conductors] + [(r[0], r[1]) for r in radiators]
    at = _positions([*nodes, *boundaries], joined + [pair for e in effects if (pair := _ends(e)) is not None])
    parts = [_line(at, a, b, "conductor", f"{number(G, 2)} W/K") for a, b, G in conductors]
    parts += [_line(at, node, sink, "radiator", "", bend=18.0) for node, sink in radiators]
    parts += [_effect(at, effect) for effect in effects]
    parts += [_box(at, name) for name in boundaries] + [_disc(at, name) for name in nodes]
    parts += [_effect_label(at, effect) for effect in effects]
    label = f"Thermal network of {len(nodes)} nodes"
    return f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def draw_flows(flows: Mapping[str, Any]) -> str:
    """Return the heat flows of one moment or phase as an ``<svg>`` element: arrows in watts, temperatures, and loads.

    Parameters
    ----------
    flows
        As ``twin_core.flows.heat_flows`` returns them.

    Returns
    -------
    str
        Empty where there are more nodes than a picture holds.
    """
    temperatures = {row["id"]: row["temperature_K"] for row in (*flows["nodes"], *flows["boundaries"])}
    if not 0 < len(temperatures) <= _MOST_PLACES:
        return ""
    ends = [(*link["ends"], link["heat_W"]) for link in flows["links"] if all(e in temperatures for e in link["ends"])]
    heat: dict[str, float] = {}
    for entry in (*flows["loads"], *flows["heaters"]):
        heat[entry["node"]] = heat.get(entry["node"], 0.0) + entry["heat_W"]
    for effect in flows["effects"]:
        where, into = effect["where"], effect["heat_W"]
        pair = _ends(effect)
        if pair is not None and pair[0] in into:
            ends.append((pair[1], pair[0], into[pair[0]]))
        elif "node" in where:
            heat[where["node"]] = heat.get(where["node"], 0.0) + into.get(where["node"], 0.0)
    joined: dict[tuple[str, str], float] = {}
    for a, b, W in ends:  # conductor and radiation between the same two are one arrow
        key = (b, a) if (b, a) in joined else (a, b)
        joined[key] = joined.get(key, 0.0) + (W if key == (a, b) else -W)
    at = _positions(list(temperatures), list(joined))
    most = max((abs(W) for W in joined.values()), default=0.0) or 1.0
    parts = [_arrow(at, *(pair if W >= 0.0 else pair[::-1]), abs(W), most) for pair, W in joined.items()]
    boundaries = {row["id"] for row in flows["boundaries"]}
    for name, temperature_K in temperatures.items():
        parts.append(_box(at, name) if name in boundaries else _disc(at, name))
        said = f"{number(temperature_K, 4)} K" + (f", loads {number(heat[name])} W" if name in heat else "")
        parts.append(_text(at[name], said, "below", 33.0))
    label = f"Heat flows between {len(temperatures)} nodes and boundaries"
    return f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _arrow(at: Mapping[str, tuple[float, float]], source: str, target: str, heat_W: float, most_W: float) -> str:
    """Return a line as wide as its heat, with a head at its middle that points to where the heat goes, and the watts."""
    (x0, y0), (x1, y1) = at[source], at[target]
    width = 1.0 + 7.0 * heat_W / most_W
    length = math.hypot(x1 - x0, y1 - y0) or 1.0
    along, size = ((x1 - x0) / length, (y1 - y0) / length), 5.0 + width
    tip = (x0 + 0.56 * (x1 - x0), y0 + 0.56 * (y1 - y0))
    back = (tip[0] - 1.6 * size * along[0], tip[1] - 1.6 * size * along[1])
    side = (-along[1] * size, along[0] * size)
    head = f"{tip[0]:.1f},{tip[1]:.1f} {back[0] + side[0]:.1f},{back[1] + side[1]:.1f}"
    line = f'<path class="flow" d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" style="stroke-width:{width:.1f}"/>'
    aside = 1.0 if along[0] >= 0.0 else -1.0  # above the line, or to the right of a steep one
    beside = (
        x0 + 0.4 * (x1 - x0) + aside * 2.2 * size * along[1],
        y0 + 0.4 * (y1 - y0) - aside * 1.2 * size * along[0],
    )
    polygon = f'<polygon class="arrow" points="{head} {back[0] - side[0]:.1f},{back[1] - side[1]:.1f}"/>'
    return line + polygon + _text(beside, f"{number(heat_W)} W", "flow-label", 3.0)


def _ends(effect: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the two places that an effect joins, None where it acts on one place alone."""
    where = effect.get("where") or {}
    if "nodes" in where:
        return where["nodes"][0], where["nodes"][1]
    other = where.get("sink") or where.get("boundary")
    return (where["node"], other) if "node" in where and other else None


def _alone(effect: Mapping[str, Any]) -> str:
    """Return the one node or boundary on which an effect acts."""
    where = effect.get("where") or {}
    return str(where.get("node") or where.get("boundary"))


def _positions(names: Sequence[str], edges: Sequence[tuple[str, str]]) -> dict[str, tuple[float, float]]:
    """Place names so that drawn distances follow the number of edges between them.

    Stress majorisation (Gansner, Koren and North, "Graph drawing by stress majorization", 2004, eq. 10), from a circle.
    """
    index = {name: i for i, name in enumerate(dict.fromkeys(names))}
    n = len(index)
    if n == 1:
        return {names[0]: (WIDTH / 2, HEIGHT / 2)}
    distance = _distances(n, [(index[a], index[b]) for a, b in edges if a in index and b in index])
    weight = np.where(distance > 0, 1.0 / np.maximum(distance, 1e-9) ** 2, 0.0)
    angle = 2.0 * math.pi * np.arange(n) / n
    spots = np.stack([np.cos(angle), 0.6 * np.sin(angle)], axis=1) * n / 3
    for _ in range(_STEPS):
        apart = spots[:, None, :] - spots[None, :, :]
        length = np.maximum(np.linalg.norm(apart, axis=2), 1e-6)
        pull = spots[None, :, :] + apart * (distance / length)[:, :, None]
        spots = np.einsum("ij,ijk->ik", weight, pull) / weight.sum(axis=1, keepdims=True)
    return dict(zip(index, map(tuple, _fit(spots)), strict=True))


def _distances(n: int, edges: Sequence[tuple[int, int]]) -> FloatArray:
    """Return the number of edges between every two places, (n, n); unconnected ones are a little further than any."""
    far = float(n)
    distance = np.full((n, n), far)
    np.fill_diagonal(distance, 0.0)
    for a, b in edges:
        distance[a, b] = distance[b, a] = 1.0
    for via in range(n):
        distance = np.minimum(distance, distance[:, via, None] + distance[None, via, :])
    reached = distance[distance < far]
    distance[distance >= far] = reached.max() + 1.0
    np.fill_diagonal(distance, 0.0)
    return distance


def _fit(spots: FloatArray) -> FloatArray:
    """Return the places turned so that the long side lies flat, scaled into the picture."""
    centred = spots - spots.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    turned = centred @ axes.T
    span = np.maximum(np.ptp(turned, axis=0), 1e-9)
    across, down = (WIDTH - 2 * MARGIN) / span[0], (HEIGHT - 2 * MARGIN) / span[1]
    scale = np.array([across, min(down, _STRETCH * across)])  # a chain stays a chain
    middle = turned.min(axis=0) + span / 2
    return np.array([WIDTH / 2, HEIGHT / 2]) + (turned - middle) * scale


def _line(at: Mapping[str, tuple[float, float]], a: str, b: str, kind: str, label: str, *, bend: float = 0.0) -> str:
    """Return a curve between two places with a label at its middle."""
    if a not in at or b not in at:
        return ""
    (x0, y0), (x1, y1) = at[a], at[b]
    middle, control = _bow(at[a], at[b], bend)
    curve = f'<path class="{kind}" d="M{x0:.1f} {y0:.1f}Q{control[0]:.1f} {control[1]:.1f} {x1:.1f} {y1:.1f}"/>'
    beside = (middle[0] - 0.08 * (x1 - x0), middle[1] - 0.08 * (y1 - y0))  # lines often cross at their middles
    return curve + (_text(beside, label, f"{kind}-label", -5.0) if label else "")


def _bow(
    start: tuple[float, float], stop: tuple[float, float], bend: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the middle of a curve that bends so many pixels aside, and its control point."""
    (x0, y0), (x1, y1) = start, stop
    length = math.hypot(x1 - x0, y1 - y0) or 1.0
    across = (-(y1 - y0) / length * bend, (x1 - x0) / length * bend)
    middle = ((x0 + x1) / 2 + across[0], (y0 + y1) / 2 + across[1])
    return middle, (middle[0] + across[0], middle[1] + across[1])


def _effect(at: Mapping[str, tuple[float, float]], effect: Mapping[str, Any]) -> str:
    """Return an effect: a curve between two places, or a ring around one; one of a channel is not drawn."""
    ends = _ends(effect)
    if ends is not None:
        return _line(at, *ends, "effect", "", bend=_EFFECT_BEND)
    node = _alone(effect)
    return _pill(at[node], node, "effect", 8.0) if node in at else ""


def _effect_label(at: Mapping[str, tuple[float, float]], effect: Mapping[str, Any]) -> str:
    """Return the effect's name, at the middle of its curve or above its ring."""
    name, ends = in_words(str(effect.get("effect"))), _ends(effect)
    if ends is not None and ends[0] in at and ends[1] in at:
        spot, _ = _bow(at[ends[0]], at[ends[1]], _EFFECT_BEND)
        return _text(spot, name, "effect-label", 4.0)
    node = _alone(effect)
    return _text(at[node], name, "effect-label", -34.0) if ends is None and node in at else ""


def _disc(at: Mapping[str, tuple[float, float]], name: str) -> str:
    return _pill(at[name], name, "node", 0.0) + _text(at[name], name, "name", 4.0)


def _box(at: Mapping[str, tuple[float, float]], name: str) -> str:
    return _pill(at[name], name, "boundary", 0.0, corner=6.0) + _text(at[name], name, "name", 4.0)


def _pill(spot: tuple[float, float], name: str, kind: str, margin: float, *, corner: float | None = None) -> str:
    """Return a shape as wide as the name needs."""
    width, height = max(46.0, 8.5 * min(len(name), _LONGEST) + 20.0) + 2 * margin, 38.0 + 2 * margin
    x, y = spot[0] - width / 2, spot[1] - height / 2
    radius = height / 2 if corner is None else corner
    return f'<rect class="{kind}" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:g}" rx="{radius:g}"/>'


def _text(spot: tuple[float, float], text: str, kind: str, shift: float) -> str:
    shown = text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
    x = spot[0] if kind == "name" else min(max(spot[0], _LABEL_ROOM), WIDTH - _LABEL_ROOM)
    return f'<text class="{kind}" x="{x:.1f}" y="{spot[1] + shift:.1f}">{escape(shown)}</text>'
