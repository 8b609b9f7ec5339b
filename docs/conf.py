"""The documentation's site: `python -m sphinx -W docs build/site`, which needs the extra `docs` and no network."""

import re
import shutil
from pathlib import Path

from cyclopts.docs import generate_markdown_docs
from sphinx_gallery.scrapers import figure_rst

from pipeline import __version__
from pipeline.cli.main import COMMANDS, command_line
from pipeline.cli.templates import rig_template, settings_template

HERE = Path(__file__).parent
GENERATED = HERE / "generated"

project = "colorphase"
author = "The colorphase authors"
copyright = author
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc", "sphinx_gallery.gen_gallery"]
root_doc = "README"
exclude_patterns = [
    "generated/commands.md",
    "generated/examples",
    "examples",
    "gallery/sg_execution_times.rst",
    "sg_execution_times.rst",
]
suppress_warnings = ["config.cache"]  # the gallery's settings hold a class

myst_enable_extensions = ["fieldlist"]
myst_heading_anchors = 4

autosummary_generate = True
templates_path = ["templates"]
autodoc_default_options = {"exclude-members": "model_config, model_post_init"}  # pydantic's own
autodoc_typehints = "none"  # the docstrings give them
numpydoc_show_class_members = False


def pictures_of_an_example(block, block_vars, gallery_conf):
    """Move the PNGs that a block of an example has written into the gallery, and return reST that shows them."""
    shown = []
    for picture in sorted(Path(block_vars["src_file"]).parent.glob("*.png"), key=lambda path: path.stat().st_mtime_ns):
        shown.append(next(block_vars["image_path_iterator"]))
        shutil.move(picture, shown[-1])
    return figure_rst(shown, gallery_conf["src_dir"])


sphinx_gallery_conf = {
    "examples_dirs": "generated/examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"(?<!dslr_camera)\.py$",  # that one needs a camera
    "image_scrapers": (pictures_of_an_example,),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
}

smartquotes = False  # two hyphens begin an option
html_theme = "furo"
html_title = f"colorphase {__version__}"
html_show_sphinx = False


def write_references(app):
    """Write the pages that the program itself knows: its commands, its settings and the keys of a rig."""
    # Examples write files where they run.
    shutil.copytree(HERE / "examples", GENERATED / "examples", dirs_exist_ok=True)
    for name in ("README", "CONTRIBUTING"):  # of the folder above; their links are relative to it
        text = (HERE.parent / f"{name}.md").read_text(encoding="utf-8")
        text = text.replace("](docs/", "](../").replace("](CONTRIBUTING.md", "](contributing.md")
        (GENERATED / f"{name.lower()}.md").write_text(text, encoding="utf-8")
    commands = generate_markdown_docs(
        command_line(list(COMMANDS)), generate_toc=False, no_root_title=True, heading_level=2
    )
    (GENERATED / "commands.md").write_text(commands, encoding="utf-8")
    (GENERATED / "settings.toml").write_text(settings_template())
    (GENERATED / "rig.toml").write_text(rig_template("box", "basler", "pjlink", display=1))


def adapt_links(app, name, source):
    """Lead links to files of the repository to their pages on the site, and put the pages of an index into the menu.

    Each section of the index becomes a section of the menu, in the same order.
    """
    text = re.sub(r"\]\((\.\./)?examples/(\w+)\.py\)", r"](/gallery/\2.rst)", source[0])
    text = text.replace("](examples)", "](gallery/index.rst)")
    if not name.startswith("generated/"):
        text = re.sub(r"\]\(\.\./(README|CONTRIBUTING)\.md", lambda found: f"](/generated/{found[1].lower()}.md", text)
    if Path(name).name == "README":
        sections = re.split(r"(?m)^(?=## )", text)
        for k, section in enumerate(sections):
            pages = "\n".join(re.findall(r"\]\(([\w/]+)\.(?:md|rst)\)", section))
            title = re.match("## (.+)", section)
            caption = f":caption: {title[1]}\n" if title else ""
            sections[k] = f"{section}\n```{{toctree}}\n:hidden:\n{caption}\n{pages}\n```\n\n"
        text = "".join(sections)
    source[0] = text


def setup(app):
    """Connect both to Sphinx."""
    app.connect("builder-inited", write_references, priority=1)  # before the gallery
    app.connect("source-read", adapt_links)
