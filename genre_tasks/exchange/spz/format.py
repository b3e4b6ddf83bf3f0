"""SPZ as an exchange format: one cloud that rests, about a quarter of a PLY file's size, with integers for numbers."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.errors import InputError
from genre_tasks.exchange.checks import check_finite_cloud, check_finite_values, read_file
from genre_tasks.exchange.one_cloud import describe_one_cloud_losses, make_resting_scene, take_one_cloud
from genre_tasks.exchange.spz.axes import turn_from_spz, turn_to_spz
from genre_tasks.exchange.spz.legacy import GZIP_MAGIC, unpack_gzip
from genre_tasks.exchange.spz.quantization import count_clipped, quantize_cloud, restore_cloud
from genre_tasks.exchange.spz.streams import MAGIC, pack_streams, unpack_streams
from genre_tasks.exchange.types import ExchangeScene, SplatCloud

_ROUNDING = (
    "SPZ stores integers: positions are rounded to a quarter of a millimetre, or more where the scene is wide.",
    "Standard deviations are rounded to steps of 6 %, rotations to a quarter of a degree, colours to 8 bits.",
)


class SpzFormat:
    """SPZ: version 4 is written, versions 1 to 4 are read.

    A file has x right, y up and z back. A scene has x forward, y left and z up, and is turned on its way.
    """

    name = "spz"
    suffixes = (".spz",)
    can_write = True
    carries_nodes = False

    def read(self, path: Path) -> ExchangeScene:
        """Reads a file.

        Args:
            path: of the file.

        Returns:
            One node that rests, in the axes of a scene; opacities of 0 and 1 become the nearest finite logits.

        Raises:
            InputError: the file is no SPZ file, is damaged, or claims more than it has.
        """
        data = read_file(path)
        if data[: len(MAGIC)] == MAGIC:
            quantized, losses = unpack_streams(path, data)
        elif data[: len(GZIP_MAGIC)] == GZIP_MAGIC:
            quantized, losses = unpack_gzip(path, data)
        else:
            raise InputError("the file is no SPZ file", remedy="It starts with NGSP, or is gzip.", file=path)
        cloud = restore_cloud(quantized)
        # Half floats of version 1 can be anything; all other numbers are finite by their making.
        check_finite_values(path, "position", cloud.means)
        return make_resting_scene(turn_from_spz(cloud), losses)

    def write(self, path: Path, scene: ExchangeScene) -> None:
        """Writes a file.

        Args:
            path: of the file.
            scene: with one node that rests.

        Raises:
            InputError: the scene has several nodes or motion, a Gaussian is too far away or too large, or a value is
                not finite.
        """
        cloud = take_one_cloud(path, scene)
        check_finite_cloud(path, cloud)
        path.write_bytes(pack_streams(quantize_cloud(path, turn_to_spz(cloud))))

    def describe_losses(self, scene: ExchangeScene) -> tuple[str, ...]:
        """Lists what of a scene SPZ cannot carry.

        Args:
            scene: to be written.

        Returns:
            Sentences on rounding, and on how many values are outside of what SPZ can hold.
        """
        clouds = [node.cloud for node in scene.nodes]
        return (*describe_one_cloud_losses(scene), *_ROUNDING, *_describe_clipping(clouds))


def _describe_clipping(clouds: list[SplatCloud]) -> tuple[str, ...]:
    counts = [count_clipped(turn_to_spz(cloud)) for cloud in clouds]
    colors = sum(count.colors for count in counts)
    harmonics = sum(count.sh_rest for count in counts)
    small = sum(count.small_scales for count in counts)
    sentences = []
    if colors:
        sentences.append(f"{colors} colour values are outside of SPZ's range, and become its nearest.")
    if harmonics:
        sentences.append(f"{harmonics} values of view-dependent colour are outside of −1 to 1, and become the nearest.")
    if small:
        sentences.append(f"{small} standard deviations are below 45 micrometres, and become that.")
    return tuple(sentences)


SPZ = SpzFormat()
