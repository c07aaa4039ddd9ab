"""The picture of the network: well-formed, complete, and with distances that follow the graph."""

import math
import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from typing import Any

from twin_core.report.network_picture import draw_network

SVG = "{http://www.w3.org/2000/svg}"


def parse(network: dict[str, Any]) -> ElementTree.Element:
    picture = draw_network(network)
    return ElementTree.fromstring(picture.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1))


def centres(root: ElementTree.Element, kind: str) -> list[tuple[float, float]]:
    shapes = [shape.attrib for shape in root.iter(f"{SVG}rect") if shape.get("class") == kind]
    return [(float(s["x"]) + float(s["width"]) / 2, float(s["y"]) + float(s["height"]) / 2) for s in shapes]


def test_every_part_is_drawn() -> None:
    root = parse(
        {
            "nodes": ["a", "b", "c"],
            "boundaries": ["space"],
            "conductors": [["a", "b", 2.0], ["b", "c", 0.5]],
            "radiators": [["a", "space"]],
            "effects": [
                {"effect": "radiation_to_sink", "where": {"node": "c", "sink": "space"}},
                {"effect": "hidden_mass", "where": {"node": "b"}},
                {"effect": "input_gain", "where": {"channel": "Q"}},
            ],
        }
    )
    classes = [element.get("class") for element in root.iter() if element.get("class")]
    assert classes.count("node") == 3 and classes.count("boundary") == 1
    assert classes.count("conductor") == 2 and classes.count("radiator") == 1
    assert classes.count("effect") == 2  # a curve and a ring; an effect on a channel has no place here
    assert {text.text for text in root.iter(f"{SVG}text")} >= {"a", "b", "c", "space", "2.0 W/K", "hidden mass"}


def test_a_chain_lies_in_order() -> None:
    names = ["n0", "n1", "n2", "n3", "n4"]
    conductors = [[a, b, 1.0] for a, b in pairwise(names)]
    spots = centres(parse({"nodes": names, "boundaries": [], "conductors": conductors}), "node")
    x = [spot[0] for spot in spots]
    assert x == sorted(x) or x == sorted(x, reverse=True)
    steps = [math.dist(a, b) for a, b in pairwise(spots)]
    assert max(steps) < 1.2 * min(steps)


def test_islands_keep_apart() -> None:
    spots = centres(parse({"nodes": ["a", "b"], "boundaries": []}), "node")
    assert math.dist(*spots) > 100


def test_names_are_escaped_and_nothing_is_nothing() -> None:
    assert "<b>" not in draw_network({"nodes": ["<b>"], "boundaries": ["<b>"]})
    assert draw_network({}) == ""
    assert draw_network({"nodes": [], "boundaries": []}) == ""
