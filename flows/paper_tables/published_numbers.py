"""The paper's numbers: tables 1 to 8 of *Diffusion-guided Generalizable Enhancer for Urban Scene Reconstruction*.

PandaSet, ten test sequences, six 1080p cameras; FID of InceptionV3 features. Captions and numbers as printed there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class PaperTable:
    """A table as printed.

    Attributes:
        number: in the paper.
        caption: as printed.
        rows: values by column, by the method's name in the paper. Columns are ``psnr`` (dB), ``ssim``, ``fid_Nm``,
            ``minutes`` (of reconstruction), ``s_per_frame``, of table 5 ``reconstruction``, ``fixer``,
            ``distillation`` and ``total`` (minutes), of table 6 ``fid_BEHAVIOUR``, and
            of table 7 ``ap``, ``recall`` and ``iou`` of ``box`` and ``mask``, and of table 8 ``map`` and
            ``ap_Nm``.
    """

    number: int
    caption: str
    rows: Mapping[str, Mapping[str, float]]


def _rows(columns: str, text: str) -> dict[str, dict[str, float]]:
    """Parses lines of ``name: number number …``."""
    names = columns.split()
    rows = {}
    for line in text.strip().splitlines():
        name, _, values = line.partition(":")
        # Strict, so that a number left out in typing is an error and not a shift of columns.
        rows[name.strip()] = dict(zip(names, map(float, values.split()), strict=True))
    return rows


PAPER: Mapping[int, PaperTable] = {
    table.number: table
    for table in (
        PaperTable(
            1,
            "Comparison to state-of-the-art reconstruction methods on interpolated and extrapolated views",
            _rows(
                "psnr ssim fid_1m fid_2m fid_3m fid_4m fid_5m minutes",
                """
                3DGS: 23.45 0.707 82.63 128.10 169.69 205.09 231.70 41.90
                StreetGS: 23.14 0.693 68.99 97.05 127.06 153.76 176.43 47.62
                SplatAD: 24.93 0.768 84.21 122.56 160.43 188.00 210.24 113.62
                G3R: 23.28 0.673 89.75 114.94 147.50 174.64 191.33 0.90
                Ours (GNet): 23.56 0.689 70.04 86.43 106.07 124.65 138.30 0.96
                StreetCrafter: 23.33 0.690 59.44 81.14 97.09 118.94 141.14 127.33
                Difix3D: 23.34 0.705 60.29 83.35 102.16 137.80 167.28 35.32
                Ours (GenRe+): 23.28 0.692 60.69 74.50 88.04 102.73 114.19 2.77
                """,
            ),
        ),
        PaperTable(
            2,
            "3D enhancer plugs into different 3DGS-based methods",
            _rows(
                "fid_0m fid_1m fid_2m fid_3m",
                """
                3DGS: 61.74 82.45 117.05 154.21
                3DGS + GenRe: 57.32 69.62 85.02 99.69
                G3R: 70.62 80.48 104.75 132.46
                G3R + GenRe (zero-shot): 65.75 74.86 89.22 100.67
                G3R + GenRe (fine-tune): 55.31 65.90 79.41 91.12
                """,
            ),
        ),
        PaperTable(
            3,
            "Comparison to state-of-the-art 2D neural fixers",
            _rows(
                "fid_1m fid_2m fid_3m s_per_frame",
                """
                StreetCrafter (V): 65.60 80.46 92.98 15.26
                Difix3D (Fixer): 59.07 75.33 91.11 0.57
                Ours (FNet): 50.12 65.55 80.27 0.83
                """,
            ),
        ),
        PaperTable(
            4,
            "Ablation study on GenRe components",
            _rows(
                "fid_1m fid_2m fid_3m fid_4m fid_5m",
                """
                GNet: 70.04 86.43 106.07 124.65 138.30
                GNet → FNet → GNet: 64.56 78.58 91.20 105.25 117.43
                GNet → FNet → ENet: 60.69 74.50 88.04 102.73 114.19
                """,
            ),
        ),
        PaperTable(
            5,
            "Runtime analysis on Difix3D and GenRe+ (in minutes)",
            _rows(
                "reconstruction fixer distillation total",
                """
                Difix3D: 12.43 0.383 22.50 35.32
                GenRe+: 0.967 0.550 1.25 2.77
                """,
            ),
        ),
        PaperTable(
            6,
            "Re-simulation evaluation with different behaviors",
            _rows(
                "fid_brake fid_accelerate fid_lane-change fid_swerve",
                """
                3DGS: 225.40 234.65 132.28 129.90
                Difix3D: 182.40 192.08 84.48 85.99
                GenRe+: 152.38 143.03 77.69 78.49
                """,
            ),
        ),
        PaperTable(
            7,
            "Downstream domain gap evaluation",
            _rows(
                "box_ap box_recall box_iou mask_ap mask_recall mask_iou",
                """
                3DGS: 0.560 0.376 0.505 0.558 0.375 0.501
                Difix3D: 0.670 0.434 0.611 0.670 0.434 0.598
                GenRe+: 0.785 0.607 0.728 0.768 0.596 0.723
                """,
            ),
        ),
        # The paper's text calls it table 9.
        PaperTable(
            8,
            "Downstream training with data augmentation",
            _rows(
                "map ap_1m ap_2m ap_4m",
                """
                Real: 0.256 0.085 0.247 0.437
                Real + Sim (3DGS): 0.258 0.097 0.246 0.430
                Real + Sim (GenRe+): 0.277 0.105 0.272 0.453
                """,
            ),
        ),
    )
}
"""The tables by their numbers in the paper."""
