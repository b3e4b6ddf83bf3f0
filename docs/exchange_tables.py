"""Tables of exchange for the documents, from the JSON file that ``genre bench exchange`` writes."""

from __future__ import annotations

from docs.result_tables import number, provenance, result, table

NAME = "exchange"
UNITS = ("dB", "s", "ms", "m", "of 255", "of 256", "bytes a Gaussian")
CLAIM_WORDS = {
    "exchange.ply_error": "Largest error of any attribute in a PLY file",
    "exchange.splat_difference": "Mean difference of images after `.splat`",
    "exchange.splat_psnr": "PSNR of images after `.splat`",
    "exchange.splat_psnr_in_range": "The same, colours cut to the range of eight bits before",
    "exchange.spz_difference": "Mean difference of images after SPZ",
    "exchange.spz_psnr": "PSNR of images after SPZ",
    "exchange.spz_bytes": "Size of SPZ without harmonics",
    "exchange.glb_error": "Largest error of any attribute in a GLB file",
    "exchange.usdz_error": "Largest error of any attribute in a USDZ file",
    "exchange.interop_missing": "Gaussians that tools of others lose or add, the most on any way through them",
    "exchange.interop_spz": "Largest error of positions, our SPZ read by Niantic's library",
    "exchange.interop_validator": "Errors of glTF's validator",
    "exchange.interop_animation": "Largest error of actors' places when three.js plays our GLB",
    "exchange.import_s": "Import of a PLY file of a million Gaussians with harmonics of degree 3",
    "exchange.import_memory": "Growth of memory for that, as a multiple of the file",
    "exchange.enhance_psnr_3m": "PSNR that `genre enhance` gains at 3 m, mean over streets",
    "exchange.enhance_perceptual_3m": "Fraction by which it lowers the perceptual distance at 3 m, without LiDAR",
    "exchange.enhance_heldout": "Loss of held-out PSNR by it",
    "exchange.page_bytes": "Size of the largest page, bytes",
    "exchange.page_problems": "Console errors and failed requests of pages without the network",
    "exchange.page_moved": "Pixels that a page's slider moves, the least",
    "exchange.answer_help": "`genre --help`",
    "exchange.answer_run": "`genre show RUN`, a run of 100 chunks",
    "exchange.answer_artifact": "`genre show KEY` in its store",
    "exchange.service_failed": "Failed calls of a rollout of 200 steps by AlpaSim's protocol",
    "exchange.service_p95": "Time of an image of 512×320, 95th percentile",
    "exchange.service_difference": "Largest difference to the library's image",
    "exchange.http_overhead": "Time that HTTP adds to an image",
    "exchange.http_difference": "Largest difference to the library's image, by HTTP",
    "exchange.driving_steps": "Steps of the driving environment a second",
    "exchange.service_faults": "Faults of services at malformed requests",
    "exchange.service_silent_refusals": "Refusals without a word",
    "exchange.service_alive": "Part of services that answer afterwards",
}
ENHANCED = {"given": "as given", "scene": "enhanced, depth of the scene", "lidar": "enhanced, depth of LiDAR"}


def claims() -> str:
    """Every claim: target, measured number, and whether it holds."""
    lines = []
    for claim in result(NAME)["claims"]:
        measured = "not measured" if claim["measured"] is None else _format(claim["measured"])
        unit = claim["unit"] if claim["unit"] in UNITS else ""
        target = f"{claim['op']} {claim['target']:g} {unit}".strip()
        # A number that nobody took neither holds nor misses.
        verdict = "–" if claim["measured"] is None else "yes" if claim["holds"] else "**missed**"
        lines.append([CLAIM_WORDS[claim["id"]], target, measured, verdict])
    return table(["claim", "target", "measured", "holds"], lines) + "\n" + provenance(NAME)


def _format(value: float) -> str:
    # Rounded to three digits, a number just below its target would look like it.
    if 0 < abs(value) < 0.1:
        return f"{value:.3g}"
    return f"{value:,.0f}" if abs(value) >= 1e5 else number(value)


def formats() -> str:
    """Every format: its size, and how far images are from those of the scene."""
    rows = [row for row in result(NAME)["rows"] if row["cell"].startswith("round trip") and "format" in row]
    head = ["format", "degree of harmonics", "bytes a Gaussian", "mean difference of 256 ↓", "PSNR, dB ↑"]
    lines = [
        [
            row["format"],
            str(row["sh_degree"]),
            f"{row['bytes_per_gaussian']:.1f}",
            f"{row['difference']:.2f}",
            f"{row['psnr_db']:.1f}",
        ]
        for row in rows
    ]
    return table(head, lines)


def enhancement() -> str:
    """Scenes before and after ``genre enhance``."""
    lines = []
    for row in result(NAME)["rows"]:
        if not row["cell"].startswith("enhancement") or "given" not in row:
            continue
        for name, words in ENHANCED.items():
            if name in row:
                scores = row[name]
                values = (f"{scores['heldout_psnr']:.2f}", f"{scores['psnr']:.2f}", f"{scores['perceptual']:.3f}")
                lines.append([row["log"].partition("=")[2], words, *values])
    head = ["street", "scene", "held-out PSNR, dB ↑", "PSNR at 3 m, dB ↑", "perceptual distance at 3 m ↓"]
    return table(head, lines)
