"""GeoJSON (RFC 7946) in metres of a named frame: polygons in, polygons and the Global IRM out.

The coordinates are not longitudes and latitudes but x and y in `map` or `odom`, hence the member `frame` beside them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from planning.graph_mirror import FRONTIER, RoadMap
from planning.polygons import PolygonError, check_rings
from schemas.fences import MAX_FENCES, MAX_RINGS, MAX_VERTICES, MAX_WEIGHT, Fence, FenceFrame, FenceKind, Ring
from services.status.problems import FieldError, ProblemError, finite

_DEFAULT_WEIGHT = 3.0
_Number = Annotated[float, Field(ge=-100_000, le=100_000, allow_inf_nan=False)]
_Position = Annotated[list[_Number], Field(min_length=2, max_length=3)]
_RingIn = Annotated[list[_Position], Field(min_length=4, max_length=MAX_VERTICES)]
_RingsIn = Annotated[list[_RingIn], Field(min_length=1, max_length=MAX_RINGS)]


class _Geo(BaseModel):
    """Foreign members are allowed (RFC 7946, 6.1)."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class PolygonIn(_Geo):
    """Rings: the outer one and its holes, each closed."""

    type: Literal["Polygon"]
    coordinates: _RingsIn


class MultiPolygonIn(_Geo):
    """Several polygons."""

    type: Literal["MultiPolygon"]
    coordinates: Annotated[list[_RingsIn], Field(min_length=1, max_length=MAX_FENCES)]


Geometry = Annotated[PolygonIn | MultiPolygonIn, Field(discriminator="type")]


class FeatureIn(_Geo):
    """A polygon with properties; `name` is shown to people. id: of the fence; an existing one is replaced."""

    type: Literal["Feature"]
    geometry: Geometry
    properties: dict[str, Any] | None = None
    id: Annotated[str, Field(max_length=64)] | None = None


class FeatureCollectionIn(_Geo):
    """Several features."""

    type: Literal["FeatureCollection"]
    features: Annotated[list[FeatureIn], Field(min_length=1, max_length=MAX_FENCES)]


GeoJsonIn = Annotated[
    PolygonIn | MultiPolygonIn | FeatureIn | FeatureCollectionIn, Field(discriminator="type")
]

_SQUARE: dict[str, Any] = {
    "type": "Polygon",
    "coordinates": [[[2.0, 1.0], [6.0, 1.0], [6.0, 4.0], [2.0, 4.0], [2.0, 1.0]]],
}


class FenceRequest(BaseModel):
    """Polygons to keep. A geofence replaces the one before; the others are added."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={"examples": [{"kind": "no_go", "frame": "map", "geojson": _SQUARE}]},
    )

    kind: FenceKind = Field(
        description="geofence: stay inside; no_go: stay out; priority: go there first.", examples=["no_go"]
    )
    frame: FenceFrame = Field(
        description="map: follows what SLAM makes of the past; odom: stays where it was drawn.",
        examples=["map"],
    )
    geojson: GeoJsonIn = Field(description="Polygons in metres of that frame.", examples=[_SQUARE])
    name: str = Field("", max_length=128, description="For people; a feature's own name goes before it.")
    weight: float = Field(
        _DEFAULT_WEIGHT, ge=1, le=MAX_WEIGHT, description="priority: so many times the ground inside counts."
    )

    def fences(self) -> list[Fence]:
        """The polygons, checked. Raises ProblemError, which names the field and the mend."""
        found = []
        for where, feature, rings in _polygons(self.geojson):
            self._check_said(where, feature)
            points = [[(float(p[0]), float(p[1])) for p in ring] for ring in rings]
            try:
                check_rings(points, MAX_VERTICES)
            except PolygonError as error:
                name = f"body.geojson{where}[{error.ring}]"
                wrong = f"{error.wrong}; {error.mend}"
                raise ProblemError(
                    422, f"{name}: {wrong}", [FieldError(field=name, message=wrong)]
                ) from error
            found.append(self._fence(feature, points))
        if len(found) > MAX_FENCES:
            raise ProblemError(422, f"body.geojson: {len(found)} polygons, over {MAX_FENCES}; send fewer")
        return found

    def _check_said(self, where: str, feature: FeatureIn | None) -> None:
        """Fences come back as features that say their kind and frame: one that says another is no oversight to carry
        out."""
        properties = (feature.properties if feature is not None else None) or {}
        for key, asked, known in (
            ("kind", self.kind.value, set(FenceKind)),
            ("frame", self.frame.value, set(FenceFrame)),
        ):
            said = properties.get(key)
            if isinstance(said, str) and said in known and said != asked:
                name = f"body.geojson{where.partition('.geometry')[0]}.properties.{key}"
                wrong = f"the feature says {said}, the request {asked}; send it as {said}, or take the property out"
                raise ProblemError(422, f"{name}: {wrong}", [FieldError(field=name, message=wrong)])

    def _fence(self, feature: FeatureIn | None, points: list[list[tuple[float, float]]]) -> Fence:
        properties = (feature.properties if feature is not None else None) or {}
        return Fence(
            fence_id=(feature.id or "") if feature is not None else "",
            kind=self.kind,
            frame=self.frame,
            name=str(properties.get("name") or self.name)[:128],
            weight=self.weight if self.kind == FenceKind.PRIORITY else 1.0,
            rings=[Ring.of(ring) for ring in points],
        )


def _polygons(
    geojson: PolygonIn | MultiPolygonIn | FeatureIn | FeatureCollectionIn,
) -> Iterator[tuple[str, FeatureIn | None, list[list[list[float]]]]]:
    """(where in the document, feature, rings) of each polygon."""
    if isinstance(geojson, FeatureCollectionIn):
        for index, feature in enumerate(geojson.features):
            for where, rings in _of_geometry(feature.geometry):
                yield f".features[{index}].geometry{where}", feature, rings
    elif isinstance(geojson, FeatureIn):
        for where, rings in _of_geometry(geojson.geometry):
            yield f".geometry{where}", geojson, rings
    else:
        for where, rings in _of_geometry(geojson):
            yield where, None, rings


def _of_geometry(geometry: PolygonIn | MultiPolygonIn) -> Iterator[tuple[str, list[list[list[float]]]]]:
    if isinstance(geometry, PolygonIn):
        yield ".coordinates", geometry.coordinates
    else:
        for index, rings in enumerate(geometry.coordinates):
            yield f".coordinates[{index}]", rings


# --- out --------------------------------------------------------------------------------------------------------


class FeatureOut(BaseModel):
    """A feature."""

    type: Literal["Feature"] = "Feature"
    id: str | None = None
    geometry: dict[str, Any]
    properties: dict[str, Any]


class FeatureCollectionOut(BaseModel):
    """Features in metres of `frame`. version: of the fences, or of the graph."""

    type: Literal["FeatureCollection"] = "FeatureCollection"
    frame: str
    units: Literal["m"] = "m"
    version: int
    features: list[FeatureOut]


def fences_geojson(version: int, fences: list[Fence]) -> FeatureCollectionOut:
    """The fences as they were drawn; each names its frame among its properties."""
    features = [
        FeatureOut(
            id=fence.fence_id,
            geometry={
                "type": "Polygon",
                "coordinates": [[[x, y] for x, y in ring.points] for ring in fence.rings],
            },
            properties={
                "kind": fence.kind.value,
                "frame": fence.frame.value,
                "name": fence.name,
                "weight": fence.weight,
            },
        )
        for fence in fences
    ]
    return FeatureCollectionOut(frame="of each feature", version=version, features=features)


def graph_json(version: int, road_map: RoadMap) -> bytes:
    """The Global IRM in `map` as GeoJSON (`FeatureCollectionOut`): breadcrumbs and frontiers as points, edges as lines.

    Written from plain values, as a graph may have 100,000 nodes; numbers that are not finite are null.
    """
    features = [*_node_features(road_map), *_edge_features(road_map)]
    whole = {
        "type": "FeatureCollection",
        "frame": "map",
        "units": "m",
        "version": version,
        "features": features,
    }
    return json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()


def _edges(road_map: RoadMap) -> Iterator[tuple[int, int]]:
    """(row, slot) of every edge once."""
    rows = np.repeat(np.arange(road_map.node_id.size), np.diff(road_map.indptr))
    slots = np.flatnonzero(rows < road_map.indices)
    return zip(rows[slots].tolist(), slots.tolist(), strict=True)


def _plain(values: NDArray[Any]) -> list[Any]:
    """A column as plain values, null where they are not finite."""
    if np.isfinite(values).all():
        plain: list[Any] = values.tolist()
        return plain
    return [finite(value) for value in values.tolist()]


def _node_features(road_map: RoadMap) -> Iterator[dict[str, Any]]:
    columns = (_plain(c) for c in (road_map.node_id, road_map.xyz_m, road_map.gain, road_map.coverage))
    kinds = (road_map.kind == FRONTIER).tolist()
    for is_frontier, node, xyz, gain, coverage in zip(kinds, *columns, strict=True):
        kind = "frontier" if is_frontier else "breadcrumb"
        yield {
            "type": "Feature",
            "id": f"node-{node}",
            "geometry": {"type": "Point", "coordinates": xyz},
            "properties": {"node": node, "kind": kind, "gain": gain, "coverage": coverage},
        }


def _edge_features(road_map: RoadMap) -> Iterator[dict[str, Any]]:
    node, xyz, other = _plain(road_map.node_id), _plain(road_map.xyz_m), road_map.indices.tolist()
    distance_m, risk, driven = _plain(road_map.distance_m), _plain(road_map.risk), road_map.driven.tolist()
    for row, slot in _edges(road_map):
        end = other[slot]
        yield {
            "type": "Feature",
            "id": None,
            "geometry": {"type": "LineString", "coordinates": [xyz[row], xyz[end]]},
            "properties": {
                "a": node[row],
                "b": node[end],
                "distance_m": distance_m[slot],
                "risk": risk[slot],
                "driven": bool(driven[slot]),
            },
        }


def graph_graphml(version: int, road_map: RoadMap) -> bytes:
    """The Global IRM as GraphML, as networkx and Gephi read it."""
    import networkx as nx

    graph: nx.Graph[int] = nx.Graph(frame="map", irm_version=version)
    for index, node in enumerate(road_map.node_id.tolist()):
        x, y, z = road_map.xyz_m[index].tolist()
        kind = "frontier" if road_map.kind[index] == FRONTIER else "breadcrumb"
        gain, seen = float(road_map.gain[index]), float(road_map.coverage[index])
        graph.add_node(node, x_m=x, y_m=y, z_m=z, kind=kind, gain=gain, coverage=seen)
    for row, slot in _edges(road_map):
        graph.add_edge(
            int(road_map.node_id[row]),
            int(road_map.node_id[road_map.indices[slot]]),
            distance_m=float(road_map.distance_m[slot]),
            risk=float(road_map.risk[slot]),
            driven=bool(road_map.driven[slot]),
        )
    return "\n".join(nx.generate_graphml(graph)).encode()
