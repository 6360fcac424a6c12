"""What the command ``model`` does: say what is in a model's file, and draw it."""

from pathlib import Path

from rich.table import Table

from torchtrack.cli.console import output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.picture import check_picture, write_picture
from torchtrack.core.atomic import check_other_file
from torchtrack.object_model.report import ModelReport, SurfaceReport, describe_model
from torchtrack.object_model.settings import METRES_PER_UNIT, Unit

# Closer to its middle than this, the origin of a model needs no mention (diameters).
_NEAR_CENTRE = 0.01


def show_model(path: Path, unit: Unit | None, scale: float, output: Path | None, *, centre: bool) -> int:
    """Show what a model is, and write a picture of six views of it; returns the exit code."""
    if output is not None:
        check_other_file(path, output)
        check_picture(output)
    report = describe_model(path, unit, scale, centre=centre)
    table = Table(show_header=False, box=None)
    for row in _rows(report, scale, centre=centre):
        table.add_row(*row)
    console = output_console()
    console.print(table)
    for note in report.notes:
        console.print(f"note: {note}", markup=False)
    if output is not None:
        # Drawing needs more of the package than facts do.
        from torchtrack.viz.model_views import draw_model

        write_picture(output, draw_model(report.model))
        console.print(f"six views are in {output}", markup=False)
    return ExitCode.DONE


def _rows(report: ModelReport, scale: float, *, centre: bool) -> list[tuple[str, str]]:
    x, y, z = report.size
    rows = [("size", f"{x:.6g} x {y:.6g} x {z:.6g} in the file's numbers" + (f", enlarged by {scale:g}" if scale != 1 else ""))]
    across = float((report.size**2).sum() ** 0.5) * scale
    rows += [("", f"in {name}: {across * metres:.4g} m across{_judged(name, report)}") for name, metres in METRES_PER_UNIT.items()]
    rows += [("unit", _unit(report)), ("origin", _origin(report, centre=centre))]
    surface = report.surface
    if surface is None:
        return [*rows, ("lines", f"{len(report.model.segments)} segments, no surface: nothing hides them")]
    return [*rows, *_surface_rows(surface), ("edges", _edges(report)), ("texture", _texture(report, surface)), ("symmetry", _symmetry(report))]


def _judged(unit: str, report: ModelReport) -> str:
    if unit == report.unit:
        return "  <-"
    return "" if unit in report.units else "  (no tracked object)"


def _unit(report: ModelReport) -> str:
    if report.is_assumed:
        others = [unit for unit in report.units if unit != report.unit]
        rest = f"; possible: {', '.join(others)}" if others else ", and the only one that is possible"
        return f"{report.unit} is the likeliest (the file does not say it){rest}"
    return report.unit


def _origin(report: ModelReport, *, centre: bool) -> str:
    where = f"the middle is at ({', '.join(f'{value:.6g}' for value in report.middle)}), {report.off_centre:.2g} diameters from the file's origin"
    if centre:
        return f"{where}; it is the origin now (centre)"
    if report.off_centre <= _NEAR_CENTRE:
        return "in the middle"
    return f"{where}; centre: true moves the origin there"


def _surface_rows(surface: SurfaceReport) -> list[tuple[str, str]]:
    parts = f", {surface.parts} parts" if surface.parts > 1 else ""
    dropped = f"; {surface.dropped_faces:,} without area or stored twice are left out" if surface.dropped_faces else ""
    closed = "yes" if surface.open_edges == 0 else f"no: {surface.open_edges:,} edges have not two faces"
    winding = "outwards" if surface.contrary_edges == 0 else f"{surface.contrary_edges:,} edges between faces that contradict each other"
    flipped = f"; {surface.flipped_faces:,} faces were flipped" if surface.flipped_faces else ""
    return [
        ("faces", f"{surface.faces:,} on {surface.vertices:,} vertices{parts}{dropped}"),
        ("watertight", closed),
        ("winding", winding + flipped),
    ]


def _edges(report: ModelReport) -> str:
    return f"{report.creases:,} creases, which always show; {report.silhouettes:,} that show where the surface turns away"


def _texture(report: ModelReport, surface: SurfaceReport) -> str:
    points = len(report.model.texture_points)
    sizes = ", ".join(f"{width}x{height}" for width, height in surface.textures)
    if points:
        return f"{points:,} points on edges of {f'the texture ({sizes} px)' if sizes else 'colours'}"
    return f"none used: {sizes} px, but no edges on the surface" if sizes else "none in the file, or it cannot be used (see the notes)"


def _symmetry(report: ModelReport) -> str:
    said = []
    if report.revolution is not None:
        said.append(f"turns unseen about the axis ({_direction(report.revolution.direction_obj.tolist())})")
    if report.turning is not None:
        said.append(f"most of it turns unseen about the axis ({_direction(report.turning.direction_obj.tolist())})")
    if len(report.planes):
        said.append("mirrored across " + ", ".join(f"({_direction(plane)})" for plane in report.planes.tolist()))
    surface_alone = " (of the surface; its print is not looked at)" if said and len(report.model.texture_points) else ""
    return ("; ".join(said) or "none") + surface_alone


def _direction(values: list[float]) -> str:
    # Neither -0.00 nor its opposite.
    return ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in values)
