"""Chart of measured and computed stress, drawn by matplotlib as an image and SVG."""

from collections.abc import Mapping, Sequence

import numpy as np

from .loglog_chart import DPI, Figure, FigureCanvasAgg, format_svg

MEASURED = "measured"  # Name of the measured curve, which is drawn as dots.


def draw_stress(
    panels: Mapping[str, tuple[np.ndarray, Mapping[str, np.ndarray]]], solid: Sequence[str]
) -> tuple[np.ndarray, str]:
    """Draw a panel for each test; return an image (height, width, 3) uint8 and an SVG element for HTML.

    `panels`: by the name of the test, stretches or shear strains (n,), and nominal stresses (n,) [Pa] by name, among
    them `MEASURED`. The curves `solid` are continuous, others dashed.
    """
    figure = Figure((12.0, 4.0), DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for axes, (test, (strain, curves)) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        axes.set(title=test, xlabel="shear strain" if test == "shear" else "stretch", ylabel="nominal stress [kPa]")
        limit = 1.4e-3 * np.abs(curves[MEASURED]).max()
        axes.set_ylim((-0.1 * limit, limit) if curves[MEASURED].sum() > 0.0 else (-limit, 0.1 * limit))
        for name, stress in curves.items():
            style = "ko" if name == MEASURED else "-" if name in solid else "--"
            axes.plot(strain, 1e-3 * stress, style, markersize=4, label=name)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize="small")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy(), format_svg(figure)
