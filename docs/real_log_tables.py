"""Tables of the page on real logs, from ``genre bench real_logs``."""

from __future__ import annotations

from statistics import median

from benchmarks.common.bench import Row
from benchmarks.optimiser.claims import gain_at_equal_renders, time_ratio_to_gnet
from docs.result_tables import claims as claims_of
from docs.result_tables import provenance, result, table

_METHOD_WORDS = {"tuned_adam": "tuned Adam", "tuned_adam_split": "tuned Adam on split Gaussians"}


def claims() -> str:
    """Claims on real logs and noisy streets."""
    return claims_of("real_logs")


def chain() -> str:
    """GNet's and ENet's scene of the KITTI slice."""
    row = next(row for row in result("real_logs")["rows"] if row.get("kind") == "chain")
    lines = [
        [
            stage,
            f"{row[key]['psnr']:.2f}",
            f"{row[key]['cc_psnr']:.2f}",
            f"{row[key]['ssim']:.3f}",
            f"{row[key]['kernel_3m']:.3f}",
        ]
        for stage, key in (("GNet", "gnet"), ("ENet", "enet"))
    ]
    head = ["scene of", "PSNR, dB", "`cc_psnr`, dB", "SSIM", "kernel distance at 3 m"]
    return table(head, lines) + "\n" + provenance("real_logs")


def effects() -> str:
    """Held-out PSNR of GNet's scene with and without the effects, log by log."""
    lines = []
    for row in result("real_logs")["rows"]:
        if row.get("kind") != "effects":
            continue
        plan = row["plan"]
        choices = [
            f"{plan[name]['choice']}, {plan[name]['value']:.2g}" for name in ("multi_view_stereo", "pose_refinement")
        ]
        lines.append([row["log"], *(f"{row[name]:.2f}" for name in ("none", "stereo", "poses", "auto")), *choices])
    head = ["log", "neither", "stereo", "poses", "by the gates", "gate of stereo, %", "gate of poses, px"]
    return table(head, lines) + "\n" + provenance("real_logs")


def pose_noise() -> str:
    """Held-out PSNR of streets whose recorded poses err."""
    lines = [
        [row["log"], *(f"{row[name]:.2f}" for name in ("exact", "noisy", "refined", "misalignment_px"))]
        for row in result("real_logs")["rows"]
        if row.get("kind") == "pose_noise"
    ]
    return (
        table(["street", "exact poses", "noisy", "refined", "misalignment, px"], lines) + "\n" + provenance("real_logs")
    )


def race() -> str:
    """GNet against tuned Adam on real logs, the median of the orders of views."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in result("real_logs")["rows"]:
        if row.get("kind") == "race":
            found.setdefault((row["log"], row["method"]), []).append(row)
    lines = []
    for (log, method), rows in found.items():
        gains = [gain for row in rows if (gain := gain_at_equal_renders(row)) is not None]
        ratios = [time_ratio_to_gnet(row) for row in rows]
        best = [max(variant["best_psnr"] for variant in row["variants"].values()) for row in rows]
        slowest = min(ratios)
        lines.append(
            [
                log,
                _METHOD_WORDS[method],
                str(len(rows)),
                f"{median(row['gnet']['seconds'] for row in rows):.1f}",
                f"{median(row['gnet']['psnr'] for row in rows):.2f}",
                f"{median(best):.2f}",
                f"{median(gains):.2f}" if gains else "–",
                f"{'' if slowest[1] else '≥ '}{slowest[0]:.1f}",
            ]
        )
    head = [
        "log",
        "against",
        "orders",
        "GNet, s",
        "GNet, PSNR",
        "its best PSNR",
        "GNet over it at equal renders, dB",
        "its time ÷ GNet's, worst order",
    ]
    return table(head, lines) + "\n" + provenance("real_logs")
