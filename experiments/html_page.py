"""One HTML file with tables, plots and pictures in it."""

import base64
import html
import io

import matplotlib.pyplot as plt
import numpy as np

from clothjax.render import ray_cast

STYLE = (
    "body{font:16px sans-serif;max-width:70em;margin:2em auto} img{max-width:100%} "
    "td,th{padding:.2em .8em;text-align:right}"
)


Section = tuple[str, str]  # title and content


def page(title: str, heading: str, sections: list[Section]) -> str:
    """Return the text of one HTML file."""
    body = "".join(f"<h2>{html.escape(name)}</h2>{content}" for name, content in sections)
    return (
        f"<!doctype html><meta charset=utf-8><title>{html.escape(title)}</title><style>{STYLE}</style>"
        f"<h1>{html.escape(heading)}</h1>{body}\n"
    )


def table(rows: dict[str, dict], columns: dict[str, str]) -> str:
    """Return a table of numbers; columns have keys of the rows, and labels."""
    head = "".join(f"<th>{html.escape(label)}</th>" for label in columns.values())
    lines = [
        f"<tr><th>{html.escape(name)}</th>"
        + "".join(f"<td>{values[key]:.3g}</td>" if key in values else "<td></td>" for key in columns)
        + "</tr>"
        for name, values in rows.items()
    ]
    return f"<table><tr><th></th>{head}</tr>{''.join(lines)}</table>"


def sheet(rows: dict[str, list[np.ndarray]], columns: list[str]) -> str:
    """Draw pictures in rows and columns."""
    buffer = io.BytesIO()
    ray_cast.comparison(buffer, rows, columns)
    return picture(buffer.getvalue())


def image(figure: plt.Figure) -> str:
    """Return a plot as an image, and close it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    plt.close(figure)
    return picture(buffer.getvalue())


def picture(png: bytes) -> str:
    """Return a PNG as an image."""
    return f'<p><img src="data:image/png;base64,{base64.b64encode(png).decode()}" alt=""></p>'
