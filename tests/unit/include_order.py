#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
#
# Checks that includes never turn back: that each file includes only files of its own folder and of
# folders before it in ORDER, and that no files include each other in a circle. Prints each include
# that breaks this, and fails.
#
#   include_order.py SOURCE_ROOT
import os
import re
import sys

# Folders in the order of dependency; a folder may include those that stand before it. Folders
# within one inner list do not include each other.
ORDER = [
    ["core/include"],
    ["core/base"],
    ["core/ring"],
    ["core/clock"],
    ["core/wire"],
    ["client/include"],
    ["client/src"],
    ["client/ssm", "client/dssmctl"],
    ["daemon/base"],
    ["daemon/service"],
    ["daemon/streams"],
    ["daemon/link"],
    ["daemon/fleet"],
    ["daemon/fleet/mdns"],
    ["daemon/serve", "daemon/remote"],
    ["daemon/clock"],
    ["daemon/local"],
    ["daemon"],
]
# What a rank alone does not say: these folders may include only the folders named (and their own).
ONLY = {
    "client/include": ["core/include"],
    "client/ssm": ["core/include", "client/include", "core/base", "core/ring"],
    "client/dssmctl": ["core/include", "client/include"],
}
INCLUDE_ROOTS = ["", "core/include", "client/include", "client/ssm/include"]
INCLUDE = re.compile(r'^\s*#\s*include\s+["<]([^">]+)[">]', re.MULTILINE)


def folder_of(path):
    """The entry of ORDER that `path` belongs to: the longest one that contains it."""
    names = [name for rank in ORDER for name in rank if path.startswith(name + "/")]
    return max(names, key=len) if names else None


def sources(root):
    for top in ("core", "client", "daemon"):
        for folder, _, files in os.walk(os.path.join(root, top)):
            for name in files:
                if name.endswith((".hpp", ".cpp", ".h")):
                    yield os.path.relpath(os.path.join(folder, name), root)


def included(root, path, text):
    for name in INCLUDE.findall(text):
        for start in [os.path.dirname(path), *INCLUDE_ROOTS]:
            candidate = os.path.normpath(os.path.join(start, name))
            if os.path.isfile(os.path.join(root, candidate)):
                yield candidate
                break


def circle(graph):
    """A list of files that include each other in a circle; None when there is no such list."""
    finished, path = set(), []

    def visit(node):
        if node in path:
            return path[path.index(node):] + [node]
        if node in finished:
            return None
        path.append(node)
        for other in graph.get(node, []):
            found = visit(other)
            if found:
                return found
        path.pop()
        finished.add(node)
        return None

    for node in graph:
        found = visit(node)
        if found:
            return found
    return None


def main(root):
    rank = {name: number for number, names in enumerate(ORDER) for name in names}
    errors, graph = [], {}
    for path in sorted(sources(root)):
        own = folder_of(path)
        if own is None:
            errors.append(f"{path}: its folder is not in ORDER of {sys.argv[0]}; add it there")
            continue
        with open(os.path.join(root, path), encoding="utf-8") as file:
            graph[path] = list(included(root, path, file.read()))
        for other_path in graph[path]:
            other = folder_of(other_path)
            if other is None or other == own:
                continue
            allowed = rank[other] < rank[own] and other in ONLY.get(own, [other])
            if own.startswith("daemon") and other.startswith("client"):
                allowed = False
            if not allowed:
                errors.append(f"{path} includes {other_path}: {own} must not include {other}")
    loop = circle(graph)
    if loop:
        errors.append("files include each other: " + " -> ".join(loop))
    if not graph:
        errors.append(f"{root} has no sources")
    for error in errors:
        print(error)
    return 1 if errors else 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: include_order.py SOURCE_ROOT")
    sys.exit(main(sys.argv[1]))
