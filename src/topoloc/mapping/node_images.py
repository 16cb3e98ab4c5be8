"""Read the images of nodes."""

from __future__ import annotations

from topoloc.mapping.storage.entries import TopoNode
from topoloc.recordings.frame import Image
from topoloc.recordings.stored_images import read_stored_image


def read_node_image(node: TopoNode) -> Image | None:
    """Return the stored image of a node, grey (H, W) or RGB (H, W, 3). None if the node has none.

    Raises:
        MapError: the image is damaged, or larger than the images of the node's camera.
    """
    if not node.template_image:
        return None
    camera = node.camera
    return read_stored_image(
        f"node {node.summary.node_id}", node.template_image, (camera.width, camera.height)
    )
