"""Formulas as MathML, which browsers draw by themselves: no script and no font is fetched."""

from __future__ import annotations

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

# Browsers set a function's name and its argument without a space between.
APPLIED, SPACE = "<mo>&ApplyFunction;</mo>", '<mspace width="0.17em"></mspace>'


def setup(app: Sphinx) -> dict[str, bool]:
    """Offer the renderer `mathml` to `html_math_renderer`."""
    app.add_html_math_renderer("mathml", (in_line, None), (display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def in_line(translator: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a sentence."""
    translator.body.append(_drawn(node, as_block=False))
    raise nodes.SkipNode


def display(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula that stands alone."""
    translator.body.append(f'<div class="formula">{_drawn(node, as_block=True)}</div>\n')
    raise nodes.SkipNode


def _drawn(node: nodes.math | nodes.math_block, as_block: bool) -> str:
    try:
        return tex2mathml(node.astext(), as_block=as_block).replace(APPLIED, SPACE)
    except MathError as error:
        logging.getLogger(__name__).warning("formula %r: %s", node.astext(), error, location=node)
        return ""
