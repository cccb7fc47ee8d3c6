#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
#
# Makes the site: all Markdown documents, and the reference of the public headers, as HTML pages.
# Fails if Doxygen warns, or if a link between pages leads nowhere. `ninja html` runs it.
#
#   build.py DOXYGEN VERSION FOLDER DEPFILE
#
# DEPFILE gets the names of all inputs, for ninja.
import glob
import os
import re
import shutil
import subprocess
import sys
import urllib.parse

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.realpath(__file__))))
INPUTS = [
    "README.md",
    "SECURITY.md",
    "docs/*.md",
    "docs/news/*.md",
    "docs/examples/**/README.md",
    "ansible/**/README.md",
    "core/include/dssm/*",
    "client/include/dssm/*",
    "client/ssm/include/**/*.h*",
]
# Of Debian's package doxygen-awesome-css; without it the site has Doxygen's own look.
STYLE = [
    "/usr/share/doxygen-awesome-css/doxygen-awesome.css",
    "/usr/share/doxygen-awesome-css/doxygen-awesome-sidebar-only.css",
]
LINK = re.compile(r'\b(?:href|src)="([^"]+)"')
NAME = re.compile(r'\b(?:id|name)="([^"]+)"')


def read(path):
    """The text of a file."""
    with open(path, encoding="utf-8") as file:
        return file.read()


def run_doxygen(doxygen, version, folder, inputs):
    """Fails when Doxygen warns."""
    settings = ["@INCLUDE = docs/site/Doxyfile", f"PROJECT_NUMBER = {version}",
                f'OUTPUT_DIRECTORY = "{folder}"', f"INPUT = {' '.join(inputs)}"]
    if all(map(os.path.exists, STYLE)):
        settings.append("HTML_EXTRA_STYLESHEET = " + " ".join(STYLE))
    done = subprocess.run([doxygen, "-"], cwd=ROOT, input="\n".join(settings), text=True)
    if done.returncode != 0:
        sys.exit("The messages of Doxygen are above; docs/site/filter.py shows how it sees a file.")


def links(folder):
    """All links of the site to itself: page, file, name in the file or empty."""
    for page in glob.glob(os.path.join(folder, "**/*.html"), recursive=True):
        for link in LINK.findall(read(page)):
            url = urllib.parse.urlsplit(link)
            if url.scheme or url.netloc:
                continue
            file = os.path.join(os.path.dirname(page), urllib.parse.unquote(url.path))
            yield page, os.path.normpath(file) if url.path else page, urllib.parse.unquote(url.fragment)


def copy_files(folder):
    """Copies the files of the sources that pages link to; their names."""
    names = {os.path.relpath(file, os.path.join(folder, "files")) for _, file, _ in links(folder)}
    names = sorted(name for name in names if not name.startswith(".."))
    for name in names:
        if os.path.isfile(os.path.join(ROOT, name)):
            copy = os.path.join(folder, "files", name)
            os.makedirs(os.path.dirname(copy), exist_ok=True)
            shutil.copyfile(os.path.join(ROOT, name), copy)
    return names


def check_links(folder):
    """Fails if a link leads nowhere."""
    broken = {f"{os.path.relpath(page, folder)}: a link is shown as text"
              for page in glob.glob(os.path.join(folder, "*.html"))
              if "](<a " in read(page) and not page.endswith("_source.html")}
    names = {}  # of the places in a page
    for page, file, name in links(folder):
        if not os.path.isfile(file):
            broken.add(f"{os.path.relpath(page, folder)}: there is no {os.path.relpath(file, folder)}")
        elif name:
            if file not in names:
                names[file] = set(NAME.findall(read(file)))
            if name not in names[file]:
                broken.add(f"{os.path.relpath(page, folder)}: there is no {name} in "
                           f"{os.path.relpath(file, folder)}")
    if broken:
        sys.exit("Links that lead nowhere:\n  " + "\n  ".join(sorted(broken)))


def main(doxygen, version, folder, depfile):
    """Makes the site in a folder that is empty at first."""
    folder = os.path.abspath(folder)
    depfile = os.path.abspath(depfile)
    target = os.path.relpath(folder)  # as ninja names it
    inputs = sorted({os.path.relpath(file, ROOT) for pattern in INPUTS
                     for file in glob.glob(os.path.join(ROOT, pattern), recursive=True)})
    shutil.rmtree(folder, ignore_errors=True)
    os.makedirs(folder)
    run_doxygen(doxygen, version, folder, inputs)
    copied = copy_files(folder)
    check_links(folder)
    # The folders, too: they change when a file is added.
    inputs = {os.path.dirname(file) for file in inputs if "/" in file}.union(
        inputs, copied, glob.glob("docs/*.svg", root_dir=ROOT), ["docs/site/Doxyfile", "docs/site/filter.py"])
    with open(depfile, "w", encoding="utf-8") as file:
        names = [os.path.join(ROOT, name).replace(" ", "\\ ") for name in sorted(inputs)]
        file.write(f"{target}: {' '.join(names)}\n")


main(*sys.argv[1:])
