"""GLB as an exchange format: parts of a scene as nodes, and an animation that moves its actors."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.exchange.checks import check_finite_cloud, read_file
from genre_tasks.exchange.gltf.accessors import AccessorReader
from genre_tasks.exchange.gltf.binary_container import split_container
from genre_tasks.exchange.gltf.document import parse_document
from genre_tasks.exchange.gltf.extras import LONGEST_WORD
from genre_tasks.exchange.gltf.scene_reader import SceneReader
from genre_tasks.exchange.gltf.scene_writer import SceneWriter
from genre_tasks.exchange.gltf.splat_attributes import MOST_SH_DEGREE
from genre_tasks.exchange.types import ExchangeScene


class GlbFormat:
    """glTF 2.0 in one file, with the ratified extension KHR_gaussian_splatting.

    The file has y up, as glTF asks: its root node turns the scene, whose z is up. Actors are nodes that one animation
    moves; one that is absent has the scale 0 meanwhile. Gaussians stay in the coordinates of their node.
    """

    name = "glb"
    suffixes = (".glb",)
    can_write = True
    carries_nodes = True

    def read(self, path: Path) -> ExchangeScene:
        """Reads a file, of this tool or of another one.

        Args:
            path: of the file.

        Returns:
            The scene. Nodes that rest are in its coordinates; moments are those of the keyframes.

        Raises:
            InputError: the file is no GLB file, is damaged, refers to other files, needs an extension that is not read,
                or asks for far more memory than its size.
        """
        text, binary = split_container(path, read_file(path))
        document = parse_document(path, text)
        return SceneReader(path, document, AccessorReader(path, document, binary)).read()

    def write(self, path: Path, scene: ExchangeScene) -> None:
        """Writes a file.

        Args:
            path: of the file.
            scene: any.

        Raises:
            InputError: a value is not finite or does not fit into float32, or the file would have 4 GiB or more.
        """
        for node in scene.nodes:
            check_finite_cloud(path, node.cloud)
        SceneWriter(path, scene).write()

    def describe_losses(self, scene: ExchangeScene) -> tuple[str, ...]:
        """Lists what of a scene glTF cannot carry.

        Args:
            scene: to be written.

        Returns:
            Sentences; empty where everything is kept.
        """
        losses = []
        degree = max((node.cloud.sh_degree for node in scene.nodes), default=0)
        if degree > MOST_SH_DEGREE:
            losses.append(f"Spherical harmonics of degree {degree} are cut to degree {MOST_SH_DEGREE}.")
        if any(node.cloud.antialiased for node in scene.nodes):
            losses.append("The format glTF has no sign for anti-aliasing: this tool alone reads it back.")
        if any(max(len(node.label), len(node.track_id)) > LONGEST_WORD for node in scene.nodes):
            losses.append(f"Labels and track ids of actors are cut to {LONGEST_WORD} characters.")
        return tuple(losses)


GLB = GlbFormat()
