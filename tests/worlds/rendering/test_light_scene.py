import numpy as np

from topoloc_worlds.rendering import light_scene
from topoloc_worlds.scene import Material, Mesh
from topoloc_worlds.shapes import join, panel


def test_a_face_has_the_colour_of_its_part_of_the_picture():
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:, 32:] = 255
    left, right = panel((0, 0, 1), (1, 0, 0), (0, 0, -1)), panel((1, 0, 1), (1, 0, 0), (0, 0, -1))
    halves = [
        Mesh(mesh.vertices, mesh.faces, 0.02 + np.array([0.48, 0.96]) * mesh.uv + [start, 0.0])
        for mesh, start in ((left, 0.0), (right, 0.48))
    ]
    colors = light_scene._colors(Material("matt", picture), join(halves))
    assert colors[:2].max() < 0.1
    assert colors[2:].min() > 0.8


def test_of_leaf_cards_as_many_are_left_as_leaves_cover():
    cards = join([panel((k, 0, 1), (1, 0, 0), (0, 0, -1)) for k in range(500)])
    leaves = np.zeros((10, 10), np.uint8)
    leaves[:3] = 255
    kept = light_scene._kept(Material("matt", (0.1, 0.4, 0.1), opacity=leaves), cards, 0)
    assert 0.22 < len(kept.faces) / len(cards.faces) < 0.38
    assert light_scene._kept(Material("matt"), cards, 0) is cards
