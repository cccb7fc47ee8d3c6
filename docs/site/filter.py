#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
#
# Doxygen's view of a file of this project, on stdout (INPUT_FILTER in Doxyfile.in). The line numbers
# do not change, so the warnings name the right line.
#
#   filter.py FILE
#
# Headers have plain comments. Those of declarations become Doxygen's:
#
#   // SPDX... and the text after it     the description of the file
#   // text                              the description of what follows
#   code;  // text                       the description of what the line declares
#   // --- words                         a heading of the list of members
#   //   word  text                      an item of a list: threads, returns, a parameter ...
#   //   other text, after an empty //   code
#
# Comments in function bodies stay as they are.
#
# In Markdown, pages and sections get names, and links lead to these names. The pages of a folder are
# listed in its README.md.
import os
import re
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.realpath(__file__))))
LINK = re.compile(r"(?<!!)\[((?:[^][]|\[[^]]*\])*)\]\((?!\w+:)([^)#\s]*)(?:#([^)\s]+))?\)")
HEADING = re.compile(r"(#+) +(.*?) *#*$")
ITEM = re.compile(r"   (?=\S)([^ ]+(?: [^ ]+)?)  +(\S.*)")
CODE = re.compile(r"""((?:"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])'|/(?![/*])|[^"/])*)(//|/\*)?(.*)""")
LITERAL = re.compile(r"""(?<!extern )"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])'""")
SCOPE = re.compile(r"\b(namespace|class|struct|union|enum|extern \"C\")\b")
CODE_SPAN = re.compile(r"(`[^`]*`)")


def page(path):
    """The name of a Markdown file's page."""
    if path == "README.md":
        return "index"
    return re.sub(r"[^\w]+", "-", os.path.splitext(path)[0]).strip("-")


def anchor(path, heading):
    """The name of a section: as in GitHub's links, with the page before it."""
    return page(path) + "-" + re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


# --- Markdown


def parent(path):
    """The page above a page in the site's tree: the README.md of its folder, or the next one above."""
    folder = path if os.path.basename(path) != "README.md" else os.path.dirname(path)
    while folder:
        folder = os.path.dirname(folder)
        if os.path.exists(os.path.join(ROOT, folder, "README.md")):
            return os.path.join(folder, "README.md")
    return ""


def linked(path, text, link, section, subpages):
    """A link of file `path` in Doxygen's words.

    `subpages` are the pages below it in the site's tree, or None where a link adds none.
    """
    file = os.path.normpath(os.path.join(os.path.dirname(path), link)) if link else path
    if os.path.isfile(os.path.join(ROOT, file, "README.md")):
        file = os.path.join(file, "README.md")
    if section:
        return f"[{text}](@ref {anchor(file, section)})"
    if file == "client/include/dssm":
        return f"[{text}](@ref dssm)"
    if not file.endswith(".md"):
        return f"[{text}](files/{file})"  # build.py copies it
    if subpages is None or path != parent(file) or file in subpages:
        return f"[{text}](@ref {page(file)})"
    subpages.add(file)
    return f'@subpage {page(file)} "{text}"'


def markdown(path, lines):
    """A page, with names for its sections."""
    fenced = False
    subpages = set()
    for number, line in enumerate(lines):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        if fenced:
            yield line
            continue
        # The first page has links to most others: only its lists are in the order of the tree.
        below = subpages if path != "README.md" or line.startswith(("* ", "| ")) else None
        line = LINK.sub(lambda m: linked(path, m[1], m[2], m[3], below), line)
        line = re.sub(r"\*\*(\w+)\*\*(?=\w)", r"<b>\1</b>", line)  # Doxygen wants a blank after **
        heading = HEADING.match(line)
        if heading:
            name = anchor(path, heading[2]) if number else page(path)
            if path != "README.md":
                line = f"{heading[1]} {heading[2]} {{#{name}}}"
            elif number == 0:  # its sections would be between the pages in the tree
                line += " {#mainpage}"
        yield line
    if path != "README.md" and os.path.basename(path) == "README.md":
        folder = os.path.dirname(path)
        siblings = {f"{folder}/{name}" for name in os.listdir(os.path.join(ROOT, folder)) if name.endswith(".md")}
        yield ""
        yield from (f"* @subpage {page(name)}" for name in sorted(siblings - subpages - {path}))


# --- headers


def escaped(text):
    """Text of a comment without characters that Doxygen gives a meaning; links to pages."""
    parts = CODE_SPAN.split(text)
    for i in range(0, len(parts), 2):
        part = re.sub(r"([<>&@\\#%])", r"\\\1", parts[i])
        part = re.sub(r"docs/([\w-]+)\.md", r'@ref docs-\1 "docs/\1.md"', part)
        parts[i] = part
    return "".join(parts)


class Header:
    """A header, while it is converted line by line."""

    def __init__(self, name):
        self.name = re.sub(r"^(core|client)/include/", "", name)  # as Doxygen knows it
        self.scopes = []  # of each open brace: whether there are declarations in it, not statements
        self.statement = ""  # what was read of a declaration or statement
        self.group = None  # how many braces are open around the present group of members
        self.column = None  # of the comment behind the last line of code
        self.c_comment = False  # in a comment that began with /*, of declarations
        self.after_empty = False  # after an empty line of a comment
        self.code = False  # in code in a comment

    def text(self, text):
        """A line of a comment, without what marks it as one."""
        item = ITEM.fullmatch(text)
        self.code = text.startswith("   ") and not item and (self.after_empty or self.code)
        self.after_empty = not text.strip()
        if self.code:
            return "   " + text
        if item:
            return f" - **{escaped(item[1])}** {escaped(item[2])}"
        return ("   " if text.startswith("   ") else " ") + escaped(text.strip())

    def follow_braces(self, code):
        """Notes which braces a line of code opens and closes."""
        for part in re.findall(r"[{};]|[^{};]+", LITERAL.sub("", code) + " "):
            if part == "{":
                self.scopes.append(bool(SCOPE.search(self.statement)))
            elif part == "}" and self.scopes:
                self.scopes.pop()
            self.statement = "" if part in "{};" else self.statement + part

    def begin_group(self, lines, number, words):
        """A ruler: from here on, members are listed below its words."""
        self.end_group(lines, number)
        self.group = len(self.scopes)
        begin = number + 1  # of the members: after the ruler, or after a comment on all of them
        while begin + 1 < len(lines) and lines[begin + 1].lstrip().startswith("//"):
            begin += 1
        begin = number + 1 if begin == number + 1 or lines[begin + 1].strip() else begin + 1
        lines[begin] += "/** @{ */"
        if begin > number + 1:  # an empty line would end the comment on the group
            lines.insert(begin, lines.pop(number + 1))
        return f"/// @name {words}"

    def end_group(self, lines, number):
        """Ends the present group, if there is one, before a line."""
        if self.group is not None:
            self.group = None
            lines[number - 1] += "/** @} */"

    def convert(self, lines):
        """Makes the lines such that Doxygen understands them."""
        for number, line in enumerate(lines):
            lines[number] = self.line(lines, number, line)

    def line(self, lines, number, line):
        """A line for Doxygen. The lines before it have been converted."""
        if self.c_comment:
            self.c_comment = "*/" not in line
            return line
        if re.match(r"///|/\*\* @", line):  # by begin_group()
            return line
        code, mark, comment = CODE.fullmatch(line).groups()
        if "SPDX" in comment:
            self.c_comment = mark == "/*"
            return f"/** @file {self.name}" if self.c_comment else f"/// @file {self.name}"
        if code.strip():
            if re.match(r"(?:\s|\w+:)*friend\b", self.statement + code):  # Doxygen would link to nothing
                self.follow_braces(code)
                return ""
            declares = all(self.scopes) and not code.startswith("#pragma")
            self.follow_braces(code)
            declares = declares and not re.search(r"[{}]\s*$", code)
            self.column = len(code) if declares and mark else None
            if self.group is not None and (len(self.scopes) < self.group or code.strip() == "private:"):
                self.end_group(lines, number)
        elif not mark or self.column != len(code):
            self.column = None
        behind = "<" if self.column is not None else ""
        if not mark or "NOLINT" in comment or not all(self.scopes) or code.strip() and not behind:
            return line
        if mark == "/*":
            self.c_comment = "*/" not in comment
            return f"{code}/**{behind}{comment}"
        ruler = re.fullmatch(r" --- (.*?)[ -]*", comment)
        if ruler:
            return code + self.begin_group(lines, number, ruler[1])
        return f"{code}///{behind}{self.text(comment)}"


def main(path):
    """Prints a file for Doxygen."""
    name = os.path.relpath(os.path.realpath(path), ROOT)
    with open(path, encoding="utf-8") as file:
        lines = file.read().splitlines()
    if path.endswith(".md"):
        lines = markdown(name, lines)
    else:
        Header(name).convert(lines)
    print("\n".join(lines))


main(sys.argv[1])
