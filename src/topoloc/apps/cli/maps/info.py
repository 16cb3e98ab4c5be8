"""topoloc info MAP|ATLAS, and the graph of a map as GraphML or GeoJSON."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import numpy as np
import tyro

from topoloc import (
    Atlas,
    Georeference,
    GeoreferenceError,
    MapError,
    Rigid3,
    TopolocError,
    TopoMetricMap,
    check_map,
    open_place,
)
from topoloc.apps.cli.maps.atlas import show_atlas
from topoloc.apps.cli.output import (
    File,
    Flag,
    UsageError,
    check_outputs,
    option,
    print_fields,
    print_line,
    print_quarters,
    write_json,
)
from topoloc.apps.quality.certificate_texts import describe_group
from topoloc.plugin import write_bytes

MAX_PROBLEMS = 20
MAX_JUNCTIONS = 5


@dataclass(frozen=True)
class Command:
    """Options of `topoloc info`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas."""
    json: File = None
    """Write the facts as JSON to this file (- for standard output)."""

    check: Flag = False
    """Also check all data of the map, and that its nodes agree with their neighbours. In an atlas,
    compare every file with its checksum. The exit status is 1 if there is a fault."""

    graph: Annotated[str | None, option("FILE.graphml|FILE.geojson")] = None
    """Write nodes, junctions and the paths between them to this file. GeoJSON needs a georeferenced
    map."""

    def run(self) -> int:
        return open_place(self.map).visit(self._show_map, self._show_atlas)

    def _show_atlas(self, atlas: Atlas) -> int:
        if self.graph:
            raise UsageError("--graph needs one map file, not an atlas")
        return show_atlas(atlas, self.check, self.json)

    def _show_map(self, path: str) -> int:
        check_outputs([self.json, self.graph], inputs=[path])
        with TopoMetricMap.load(path) as topomap:
            found = check_map(path) if self.check else []
            if found:
                for fault in found[:MAX_PROBLEMS]:
                    print_line(fault)
                raise MapError(f"map {path} is damaged: {len(found)} faults, the first: {found[0]}")
            if self.graph:
                write_graph(topomap, Path(self.graph))
            info = topomap.describe(path) | ({"check": "ok"} if self.check else {})
        if self.json != "-":
            _print(info, topomap)
        write_json(self.json, info)
        return 0


_NO_SCALE = "none: lengths are in units of the map (topoloc scale sets it)"


def _print(info: dict[str, Any], topomap: TopoMetricMap) -> None:
    certificate = topomap.certificate
    nodes, features = (info["config"].get(name, {}) for name in ("nodes", "features"))
    normalization, nan = features.get("normalization"), float("nan")
    geo, unknown = info["georeference"], "unknown (topoloc georeference sets it)"
    place = unknown if geo is None else str(Georeference.from_json(geo))
    has_scale = "scale" not in info
    unit = "m" if has_scale else "units"
    extent = " x ".join(f"{e:.1f}" for e in info["extent_m" if has_scale else "extent"])
    extent = f"{extent} {unit}"
    d_thresh, lambda_rot = (nodes.get(name, nan) for name in ("d_thresh", "lambda_rot"))
    kinds = ", ".join(info["kinds"]) + (f", normalization {normalization}" * bool(normalization))
    floors = "look alike" if info["config"].get("look_alike_floors") else "do not look alike"
    of_sessions = [f"{one['name']} ({one['num_nodes']} nodes)" for one in info["sessions"]]
    print_fields(
        [
            ("map", info["path"]),
            ("id", f"{info['map']}, version {info['version']}"),
            ("size", f"{info['bytes'] / 1e6:.2f} MB"),
            ("nodes", f"{info['num_nodes']}, {info['num_points']} points with 3-D position"),
            ("side nodes", str(info["num_side_nodes"])),
            ("place images", str(info["num_place_images"])),
            ("junctions", _format_junctions(info["junctions"])),
            ("mapped", f"{format_mapped(info)}, extent {extent}"),
            *([] if has_scale else [("scale", _NO_SCALE)]),
            ("recordings", ", ".join(of_sessions or info["recordings"])),
            ("on earth", place),
            *(
                ("coarse localizer", _format_coarse(facts, info["default_coarse"]))
                for facts in info["coarse_models"]
            ),
            ("Eq. 1", f"D_thresh {d_thresh:.3g} {unit}, lambda {lambda_rot:.3g} {unit}/rad"),
            ("features", kinds),
            ("floors", f"{floors} (topoloc update --look-alike-floors changes it)"),
            ("certificate", _describe_certificate(info["certificate"])),
            *([("threshold", certificate.describe_threshold())] if certificate else []),
            *map(describe_group, certificate.groups if certificate else ()),
            *([("check", info["check"])] if "check" in info else []),
        ]
    )
    print_quarters(certificate.quarters if certificate else [])


def format_mapped(info: dict[str, Any]) -> str:
    """Return the mapped length of `TopoMetricMap.describe` with its unit."""
    return f"{info['length_m']:.1f} m" if "length_m" in info else f"{info['length']:.1f} units"


def _format_junctions(junctions: list[dict[str, Any]]) -> str:
    texts = [
        f"node {one['node']} at {', '.join(f'{value:.1f}' for value in one['position'])}"
        for one in junctions[:MAX_JUNCTIONS]
    ]
    left_out = len(junctions) - len(texts)
    listed = "; ".join([*texts, f"{left_out} more (--json)"] if left_out else texts)
    return f"{len(junctions)}: {listed}" if listed else "none"


def _describe_certificate(certificate: dict[str, Any] | None) -> str:
    if certificate is None:
        return "none (topoloc certify measures how often answers are wrong)"
    if certificate["is_outdated"]:
        return f"outdated: of version {certificate['map_version']}. {certificate['promise']}"
    return f"{certificate['date']}: {certificate['promise']}"


def _format_coarse(facts: dict[str, Any], default: str) -> str:
    name, weights = facts["name"], facts.get("weights")
    if isinstance(weights, dict):  # the settings of a model are any JSON
        weights = f"{weights.get('file')}, SHA-256 {str(weights.get('sha256'))[:12]}"
    network = (
        f", {facts['backbone']} ({weights or 'from random weights'})" if "backbone" in facts else ""
    )
    return f"{name}{' (default)' * (name == default)}{network}, {facts['bytes'] / 1e6:.2f} MB"


_TYPES = {bool: "boolean", int: "long", float: "double", str: "string"}


@dataclass(frozen=True, eq=False)
class MapGraph:
    """`nodes` by their ids and `edges` by the ids of source and target, each with its facts.

    Facts of a node: session, name, world_from_cam (x, y, z in metres; qw, qx, qy, qz), number of
    points, number of outgoing edges, and whether it is the node nearest to a junction.
    Facts of an edge: metres (units of a map without scale), source_from_target, and how often
    mapping images traversed it.
    """

    nodes: dict[int, dict[str, Any]]
    edges: dict[tuple[int, int], dict[str, Any]]


def build_graph(topomap: TopoMetricMap) -> MapGraph:
    """Return the graph of a map. Traversals are counted from its place images."""
    poses = {summary.node_id: summary.world_from_cam for summary in topomap.summaries}
    out = Counter(edge.source_id for edge in topomap.edges)
    junctions = {one["node"] for one in topomap.junctions}
    nodes: dict[int, dict[str, Any]] = {
        s.node_id: {
            "session": s.session_id,
            "name": s.name,
            **_pose(s.world_from_cam),
            "points": s.num_points,
            "ways_out": out[s.node_id],
            "is_junction": s.node_id in junctions,
        }
        for s in topomap.summaries
    }
    walked, edges = _count_traversals(topomap), {}
    unit = "metres" if topomap.config.has_scale else "units"
    for edge in topomap.edges:
        source_from_target = poses[edge.source_id].inverse() @ poses[edge.target_id]
        length = float(np.linalg.norm(source_from_target.translation))
        pair = (edge.source_id, edge.target_id)
        edges[pair] = {unit: length, **_pose(source_from_target), "times": walked[pair]}
    return MapGraph(nodes, edges)


def write_graph(topomap: TopoMetricMap, path: Path) -> None:
    """Write the graph in the format of the suffix: .graphml, or .geojson. Raises TopolocError:
    another suffix, or the file cannot be written; GeoreferenceError: GeoJSON of a map that is not
    georeferenced."""
    graph, ending = build_graph(topomap), path.suffix.lower()
    if ending == ".graphml":
        write_bytes(path, _to_graphml(graph))
    elif ending in (".geojson", ".json"):
        write_bytes(path, _to_geojson(topomap, graph))
    else:
        raise TopolocError(f"{path}: a graph is written as .graphml or .geojson")


def _count_traversals(topomap: TopoMetricMap) -> Counter[tuple[int, int]]:
    """Count the changes from node to node between successive mapping images of a session."""
    last, walked = dict[int, int](), Counter[tuple[int, int]]()
    for image in topomap.place_images:
        before = last.get(image.session_id)
        if before is not None and before != image.node_id:
            walked[before, image.node_id] += 1
        last[image.session_id] = image.node_id
    return walked


def _pose(a_from_b: Rigid3) -> dict[str, float]:
    values = [*a_from_b.translation.tolist(), *a_from_b.quat_wxyz().tolist()]
    return dict(zip(("x", "y", "z", "qw", "qx", "qy", "qz"), values, strict=True))


def _to_graphml(graph: MapGraph) -> bytes:
    root = ElementTree.Element("graphml", xmlns="http://graphml.graphdrawing.org/xmlns")
    for of, entries in (("node", graph.nodes), ("edge", graph.edges)):
        for name, value in next(iter(entries.values()), {}).items():
            attributes = {"id": f"{of}_{name}", "for": of, "attr.name": name}
            ElementTree.SubElement(root, "key", attributes | {"attr.type": _TYPES[type(value)]})
    top = ElementTree.SubElement(root, "graph", id="map", edgedefault="directed")
    for node_id, facts in graph.nodes.items():
        _add_attributes(ElementTree.SubElement(top, "node", id=f"n{node_id}"), "node", facts)
    for (source, target), facts in graph.edges.items():
        edge = ElementTree.SubElement(top, "edge", source=f"n{source}", target=f"n{target}")
        _add_attributes(edge, "edge", facts)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _add_attributes(element: ElementTree.Element, of: str, facts: dict[str, Any]) -> None:
    for name, value in facts.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        text = "".join(c for c in text if c.isprintable())
        ElementTree.SubElement(element, "data", key=f"{of}_{name}").text = text


def _to_geojson(topomap: TopoMetricMap, graph: MapGraph) -> bytes:
    from topoloc.apps.export.formats import coordinates, geojson_feature  # they need OpenCV

    georeference = topomap.georeference
    if georeference is None:
        raise GeoreferenceError(
            "the map is not georeferenced (topoloc georeference); .graphml needs no position"
        )
    places: dict[int, Any] = {
        s.node_id: coordinates(georeference.geopose(s.world_from_cam).position)
        for s in topomap.summaries
    }
    features = [
        geojson_feature("Point", places[node_id], {"node": node_id} | facts)
        for node_id, facts in graph.nodes.items()
    ]
    features += [
        geojson_feature(
            "LineString", [places[source], places[target]], {"from": source, "to": target} | facts
        )
        for (source, target), facts in graph.edges.items()
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}).encode()
