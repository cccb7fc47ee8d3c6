#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
#
# Checks rules about the sources that no other tool checks. Prints each breach, and fails if there is
# one.
#
#   source_rules.py SOURCE_ROOT
#
# * Includes never turn back: each file includes only files of its own folder and of folders before
#   it in ORDER, and no files include each other in a circle.
# * A file with more than MAX_WITHOUT_ESSAY lines opens with a comment that says what it does; for
#   x.cpp the comment may be in x.hpp.
# * A ruler is one line: "// --- words". No comment is longer than MAX_LINE columns (clang-format
#   leaves comments alone, because it breaks tables).
# * No constant of a source file has the name of one of the public headers: it would hide that from
#   the sources that are compiled with it at once.
# * A source includes, itself or by another header, the header of each function that it calls.
#   Compiling many sources at once hides a missing include. This looks only at functions outside of
#   classes whose names no other header declares; `./check alone` finds all.
# * A path of the sources in README.md or a document of docs/, and the target of a link, exists.
# * Files of others, which are in the tree unchanged, are what the SHA256SUMS of their folder says.
import glob
import hashlib
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
    ["core/channel"],
    ["client/include"],
    ["client/src"],
    ["client/ssm", "client/recording"],
    ["client/dssmctl", "client/python"],
    ["client/view"],
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
# What a rank alone does not say: these folders may include only the folders and files named (and
# their own).
ONLY = {
    "client/include": ["core/include"],
    "client/ssm": ["core/include", "client/include", "core/base"],
    "client/recording": ["core/include", "client/include", "core/base"],
    "client/python": ["core/include", "client/include"],
    # dssmctl: besides the public headers the names of streams, the names and ids of hosts, which
    # certificates hold, the format of SSM's logs, and the memory that it shares with programs in
    # lockstep.
    "client/dssmctl": [
        "core/include",
        "client/include",
        "core/base/names.hpp",
        "core/base/sealed_memory.hpp",
        "core/base/seconds.hpp",
        "core/base/ssm_log.hpp",
        "core/base/text.hpp",
        "core/base/time.hpp",
        "core/base/try.hpp",
        "core/base/unique_fd.hpp",
        "core/clock/lockstep_page.hpp",
        "core/wire/host_id.hpp",
    ],
    # dssm-view: the public headers, what dssmctl shows, and how recordings describe streams.
    "client/view": [
        "core/include",
        "client/include",
        "client/dssmctl",
        "client/recording/ros2_schema.hpp",
        "client/recording/stream_channel.hpp",
        "core/base/try.hpp",
    ],
}
INCLUDE_ROOTS = ["", "core/include", "client/include", "client/ssm/include"]
MAX_WITHOUT_ESSAY = 200
MAX_LINE = 100
# A comment that is the second half of a ruler: only dashes, or words before dashes.
SPLIT_RULER = re.compile(r"^\s*//(?! ---? ?\w).*---+$")
# A path of the sources, without its ending where that is .hpp and .cpp; with * and {a,b}.
SOURCE_PATH = re.compile(r"(?<![\w./-])(?:core|client|daemon|proto|tests|scripts)/[\w./{,}*-]*[\w}*/]")
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]+)")
CODE_BLOCK = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
# Comments and strings.
IGNORED = re.compile(r'//[^\n]*|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'')
# Functions outside of classes, whose lines are not indented, and functions of classes.
FUNCTION = re.compile(r"^(?!return|using|typedef|friend|else|#|namespace|class|struct|enum)"
                      r"(?:\[\[[\w:]+\]\] )?[\w:<>,&*\s]+?[\s&*](\w+)\(", re.MULTILINE)
MEMBER = re.compile(r"^ +(?:\[\[\w+\]\] )?[\w:<>,&*\s]+?[\s&*](\w+)\(", re.MULTILINE)
INCLUDE = re.compile(r'^\s*#\s*include\s+["<]([^">]+)[">]', re.MULTILINE)


def folder_of(path):
    """The entry of ORDER that `path` belongs to: the longest one that contains it."""
    names = [name for rank in ORDER for name in rank if path.startswith(name + "/")]
    return max(names, key=len) if names else None


def sources(root, tops):
    for top in tops:
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


def has_essay(root, path):
    """Whether the file, or x.hpp for x.cpp, has a comment after its line with the licence."""
    for name in (path, path.removesuffix(".cpp") + ".hpp"):
        full = os.path.join(root, name)
        if os.path.isfile(full):
            with open(full, encoding="utf-8") as file:
                if re.match(r"// SPDX.*\n//\n// \S", file.read()):
                    return True
    return False


def comment_errors(root):
    for path in sorted(sources(root, ("core", "client", "daemon", "docs", "tests"))):
        with open(os.path.join(root, path), encoding="utf-8") as file:
            lines = file.read().splitlines()
        for number, line in enumerate(lines, 1):
            if SPLIT_RULER.match(line):
                yield f"{path}:{number}: a ruler is one line: // --- words"
            if len(line.rstrip("\n")) > MAX_LINE and line.lstrip().startswith("//"):
                yield f"{path}:{number}: the comment is longer than {MAX_LINE} columns; wrap it"
        if len(lines) > MAX_WITHOUT_ESSAY and not has_essay(root, path):
            yield f"{path}: {len(lines)} lines, and no comment at the top says what they do"


def hiding_errors(root):
    def constants(path, pattern):
        with open(os.path.join(root, path), encoding="utf-8") as file:
            return [name for line in re.findall(pattern, file.read(), re.M)
                    for name in re.findall(r"\b(k[A-Z]\w*)\b(?=\s*[={])", line)]

    public = {name: path for path in sources(root, ("core/include", "client/include"))
              for name in constants(path, r"^inline constexpr .*$")}
    for path in sorted(sources(root, ("core", "client", "daemon"))):
        if path.endswith(".cpp"):
            for name in constants(path, r"^constexpr .*$"):
                if name in public:
                    yield f"{path}: {name} hides the one of {public[name]}; give it another name"


def include_errors(root):
    rank = {name: number for number, names in enumerate(ORDER) for name in names}
    graph = {}
    for path in sorted(sources(root, ("core", "client", "daemon"))):
        own = folder_of(path)
        if own is None:
            yield f"{path}: its folder is not in ORDER of {sys.argv[0]}; add it there"
            continue
        with open(os.path.join(root, path), encoding="utf-8") as file:
            graph[path] = list(included(root, path, file.read()))
        for other_path in graph[path]:
            other = folder_of(other_path)
            if other is None or other == own:
                continue
            only = ONLY.get(own, [other])
            allowed = rank[other] < rank[own] and (other in only or other_path in only)
            if own.startswith("daemon") and other.startswith("client"):
                allowed = False
            if not allowed:
                yield f"{path} includes {other_path}: {own} must not include {other}"
    loop = circle(graph)
    if loop:
        yield "files include each other: " + " -> ".join(loop)
    if not graph:
        yield f"{root} has no sources"


def missing_include_errors(root):
    code, graph = {}, {}
    for path in sources(root, ("core", "client", "daemon")):
        with open(os.path.join(root, path), encoding="utf-8") as file:
            text = file.read()
        code[path] = IGNORED.sub("", text)
        graph[path] = list(included(root, path, text))
    declared, members = {}, set()
    for path in code:
        if path.endswith(".hpp"):
            for name in FUNCTION.findall(code[path]):
                declared.setdefault(name, set()).add(path)
            members.update(MEMBER.findall(code[path]))
    unique = {name: min(paths) for name, paths in declared.items()
              if len(paths) == 1 and name not in members}
    for path in sorted(code):
        reached, todo = set(), [path]
        while todo:
            reached.add(todo[-1])
            todo.extend(other for other in graph[todo.pop()] if other not in reached)
        known = {*FUNCTION.findall(code[path]), *re.findall(r"\bauto (\w+) = \[", code[path])}
        for name in sorted(set(re.findall(r"(?<![\w.>:])(?:[a-z]+::)?([a-z]\w*)\(", code[path]))):
            if name in unique and unique[name] not in reached and name not in known:
                yield f"{path} calls {name}(), and does not include {unique[name]}"


def path_exists(pattern):
    choice = re.search(r"{([^}]*)}", pattern)
    if choice:
        return all(path_exists(pattern.replace(choice[0], one, 1)) for one in choice[1].split(","))
    return bool(glob.glob(pattern) or glob.glob(pattern + ".[hc]pp"))


def document_errors(root):
    documents = glob.glob(os.path.join(root, "docs/**/*.md"), recursive=True)
    for path in sorted([os.path.join(root, "README.md"), *documents]):
        with open(path, encoding="utf-8") as file:
            text = file.read()
        named = [os.path.join(root, name) for name in SOURCE_PATH.findall(text)]
        prose = CODE_BLOCK.sub("", text)  # where a lambda looks like a link
        linked = [os.path.join(os.path.dirname(path), name) for name in LINK.findall(prose)]
        for name in sorted({*named, *linked}):
            if not path_exists(name):
                yield f"{os.path.relpath(path, root)}: there is no {os.path.relpath(name, root)}"


def checksum_errors(root):
    for sums in sorted(glob.glob(os.path.join(root, "client/**/SHA256SUMS"), recursive=True)):
        folder = os.path.dirname(sums)
        where = os.path.relpath(folder, root)
        with open(sums, encoding="utf-8") as file:
            expected = dict(reversed(line.split(maxsplit=1)) for line in file.read().splitlines())
        for name in sorted({*expected, *os.listdir(folder)} - {"SHA256SUMS"}):
            path = os.path.join(folder, name)
            if not os.path.exists(path):
                yield f"{where}: there is no {name}, which SHA256SUMS lists"
            elif name not in expected:
                yield f"{where}/{name} is not in SHA256SUMS: sha256sum {name} >> SHA256SUMS"
            else:
                with open(path, "rb") as file:
                    found = hashlib.sha256(file.read()).hexdigest()
                if found != expected[name]:
                    yield (f"{where}/{name} is not the file that SHA256SUMS lists: files of others "
                           "stay unchanged; for a new version write its checksum there")


def main(root):
    errors = [*include_errors(root), *hiding_errors(root), *comment_errors(root),
              *missing_include_errors(root), *document_errors(root), *checksum_errors(root)]
    for error in errors:
        print(error)
    return 1 if errors else 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: source_rules.py SOURCE_ROOT")
    sys.exit(main(sys.argv[1]))
