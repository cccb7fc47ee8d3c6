# SPDX-License-Identifier: Apache-2.0
#
# Prints the code block of a Markdown text that follows the line "<!-- file: NAME -->"; NAME comes
# with -v name=NAME. Fails when there is none.
$0 == "<!-- file: " name " -->" { found = 1; next }
found == 1 && /^```/ { found = 2; next }
found == 2 && /^```/ { found = 3 }
found == 2 { print }
END { exit found == 3 ? 0 : 1 }
