"""HTML pages of pictures and tables, which load nothing."""

import base64
import os
from collections.abc import Mapping
from importlib import resources
from typing import Any

from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically
from jaxmark.plot.figures import Picture


def write_page(path: str | os.PathLike[str], title: str, pictures: Mapping[str, Picture], **parts: Any) -> None:
    """Write a page by the template `page.html`. Needs the extra `plot`.

    Args:
        path: file for the page.
        title: its title.
        pictures: pictures by their headings.
        parts: `tables`, objects with `title`, `heads`, `lines` and `remark`; as needed `about`, a sentence below the
            title; `alt`, the end of each picture's description; sentences as `notes` and `refusals`; and `nowrap`,
            whether cells stay on one line.

    Raises:
        JaxmarkError: if Jinja2 is missing, or the page cannot be written.
    """
    jinja2 = require("jinja2", "plot")
    template = resources.files("jaxmark.plot").joinpath("page.html").read_text(encoding="utf-8")
    page = jinja2.Environment(autoescape=True).from_string(template)
    encoded = {name: base64.b64encode(picture.png()).decode() for name, picture in pictures.items()}
    write_atomically(path, page.render(title=title, pictures=encoded, **parts).encode())
