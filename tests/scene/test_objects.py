"""What moves as a whole: shapes with a common name, and those that the user groups."""

from __future__ import annotations

from typing import Any

from scenecaptum.scene import SceneGraph, find_objects, load_scene, touching
from scenecaptum.scene._objects import stems


def test_objects_of_shapes() -> None:
    assert stems(["chair_seat", "chair_leg_0", "desk"]) == {
        "chair_seat": "chair",
        "chair_leg_0": "chair",
        "desk": "desk",
    }
    assert set(stems(["chair_1_seat", "chair_1_leg", "chair_2_seat"]).values()) == {"chair_1", "chair_2"}
    # As shapes without a name of their own are numbered.
    unnamed = ["rectangle", "rectangle_2", "rectangle_3"]
    assert list(stems(unnamed).values()) == unnamed
    assert set(stems([*unnamed, "rectangle_frame"]).values()) == {"rectangle"}
    lamps = ["lamp_left", "lamp_left_rod", "lamp_right", "lamp_right_rod_a"]
    assert list(stems(lamps).values()) == ["lamp_left", "lamp_left", "lamp_right", "lamp_right"]
    walls = ["mat-Wall_rectangle", "mat-Wall_rectangle_2"]
    assert list(stems([*walls, "mat-Blend_sphere"]).values()) == [walls[0], walls[0], "mat-Blend"]
    assert set(stems(["mesh-Chair_leg", "mesh-Chair_seat"]).values()) == {"mesh-Chair"}
    assert list(stems(["mesh_1", "mesh_2"]).values()) == ["mesh_1", "mesh_2"]
    assert set(stems(["lamp_foot", "lamp_foot_top", "lamp_arm"]).values()) == {"lamp"}


def test_objects_of_the_office(mi: Any) -> None:
    graph = SceneGraph(load_scene("office"))
    found = {one.name: one for one in find_objects(graph, {"lamp": ["lamp_*", "bulb"]})}
    assert len(found["lamp"].shapes) == 8
    assert "bulb" not in found
    assert {
        "desk",
        "chair",
        "curtain",
        "luminaire_left",
        "luminaire_right",
        "keyboard",
        "sky",
    } <= found.keys()
    assert len(found["chair"].shapes) == 9
    assert sum(len(one.shapes) for one in found.values()) == len(graph.shapes())
    low, high = found["desk"].box.tolist()
    assert low[2] == 0
    assert abs(high[2] - 0.74) < 1e-6
    assert found["desk"].pivot[2] == (low[2] + high[2]) / 2


def test_an_object_can_be_a_part_of_another(mi: Any) -> None:
    graph = SceneGraph(load_scene("office"))
    groups = {
        "head": ["lamp_shade_*", "bulb"],
        "lamp": ["lamp_*", "bulb"],
        "desk": ["desk_*", "lamp_*", "bulb"],
    }
    found = {one.name: one for one in find_objects(graph, groups)}
    assert found["head"].part_of == ("lamp", "desk")
    assert found["lamp"].part_of == ("desk",)
    assert found["desk"].part_of == found["chair"].part_of == ()
    assert set(found["head"].keys) < set(found["lamp"].keys) < set(found["desk"].keys)
    assert found["head"].is_related(found["desk"])
    assert not found["head"].is_related(found["chair"])
    assert "head" in touching(found.values(), found["chair"], 10.0)
    assert "head" not in touching(found.values(), found["desk"], 10.0)
