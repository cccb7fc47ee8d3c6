# SPDX-License-Identifier: Apache-2.0
#
# Prints the code block after the line "<!-- file: NAME -->" of a Markdown text, with NAME from
# -v name=NAME. Fails when there is none.
$0 == "<!-- file: " name " -->" { found = 1; next }
found == 1 && /^```/ { found = 2; next }
found == 2 && /^```/ { found = 3 }
found == 2 { print }
END { exit found == 3 ? 0 : 1 }
