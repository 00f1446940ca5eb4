"""How Sphinx builds the pages: `make docs`. Nothing is fetched, neither here nor in the browser."""

import sys
from pathlib import Path

from sim.runtime.versions import get_version

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "sulcus"
author = "the sulcus authors"
copyright = "the sulcus authors, Apache-2.0"
version = release = get_version("sulcus")

extensions = [
    "generated_pages",
    "mathml",
    "plain_docstrings",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["extensions", "generated/scripts"]
suppress_warnings = ["config.cache"]

# Markdown, as a code host shows it.
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4

# Docstrings have names in single backticks: a link where there is such a name, code elsewhere.
default_role = "py:obj"
add_module_names = False
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autosummary_generate = False
maximum_signature_line_length = 100
python_use_unqualified_type_names = True

sphinx_gallery_conf = {
    "examples_dirs": "generated/scripts",
    "gallery_dirs": "generated/examples",
    # What runs in seconds is run, and what it prints is shown; the others need a solve or a data set.
    "filename_pattern": r"/yeoh\.py$",
    "image_scrapers": (),
    "reset_modules": (),
    "backreferences_dir": None,
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
    # Images in docs/examples, made by `make thumbnails`.
    "thumbnail_size": (320, 224),
    "remove_config_comments": True,
}

html_theme = "pydata_sphinx_theme"
html_title = "sulcus"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["pages.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "show_prev_next": True,
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
}
