"""Mathematics as MathML, which browsers draw by themselves: no script, no font, no request."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

_FUNCTION = r"\\(?:sin|cos|tan|arctan|exp|ln|log|max|min)\b"


def _spaced(latex: str) -> str:
    """Set functions off from the letters beside them, which browsers do not."""
    latex = re.sub(rf"(?<=[\w)\]}}])\s*(?={_FUNCTION})", r"\\,", latex)
    return re.sub(rf"({_FUNCTION})\s+(?=[A-Za-z\\])", r"\1\\,", latex)


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(tex2mathml(_spaced(node.astext()), as_block=False))
    raise nodes.SkipNode


def _block(self: Any, node: nodes.math_block) -> None:
    self.body.append(
        f'<div class="equation">{tex2mathml(_spaced(node.astext()), as_block=True)}</div>'
    )
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Offer the renderer as ``html_math_renderer = "mathml"``."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
