"""`rainstereo export`: the de-rainer for other programs, as ONNX or torch.export's program, checked against torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.run_record import Record, write_atomically

SIZES = ((64, 96), (75, 130), (33, 20))
TOLERANCE = 1e-3


@dataclass(frozen=True)
class Options:
    """Write the de-rainer for other programs, and check that it computes the same.

    ONNX: opset 18, float32, any number of images and any size whose sides are multiples of what the file's metadata
    say; `rainstereo derain --backend onnx --checkpoint FILE` runs it. A report.json is written beside it.
    """

    out: Path = Path("derain.onnx")
    """File to write: .onnx, or .pt2 for torch.export.load."""
    checkpoint: Path | None = None
    """Weights in place of those of the package."""


def run(options: Options) -> int:
    """Export and check; 0, or 1 if ONNX Runtime finds something else than torch."""
    record = Record("export", options)
    if options.out.suffix not in (".onnx", ".pt2"):
        raise ValueError(f"--out {options.out} was given; expected a name that ends in .onnx or .pt2")
    from rainstereo.model import export
    from rainstereo.model.generator import Generator
    from rainstereo.model.restore import opened

    found = opened(options.checkpoint)
    network = found.build()
    if not isinstance(network, Generator):
        raise ValueError(f"{found.path} holds {found.architecture}; only the generator can be exported")
    told = {"checkpoint": found.path.name, "sha256": str(found.card.get("sha256", ""))}
    data = export.to_onnx(network, told) if options.out.suffix == ".onnx" else export.to_program(network)
    write_atomically(options.out, data)
    record["bytes"] = len(data)
    if options.out.suffix == ".onnx":
        worst = export.difference(network, options.out, SIZES)
        record["opset"], record["largest_difference"], record["sizes"] = export.OPSET, worst, SIZES
        record.status = "ok" if worst <= TOLERANCE else "incomplete"
        print(f"{options.out}: {len(data) / 1e6:.2f} MB, opset {export.OPSET}; ONNX Runtime differs by {worst:.1e}")
    else:
        worst = 0.0
        print(f"{options.out}: {len(data) / 1e6:.2f} MB, torch.export")
    record.write(options.out.with_name(f"{options.out.stem}.report.json"))
    return DONE if worst <= TOLERANCE else FAILED
