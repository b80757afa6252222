#!/bin/sh
# Refuses a commit message whose first line is not `package: what changed` in at most 72 characters.
subject=$(sed -n 1p "$1")
case $subject in
    "Merge "* | "Revert "* | "fixup! "*) exit 0 ;;
esac
if [ "${#subject}" -gt 72 ] || ! printf '%s\n' "$subject" | grep -qE '^[a-z0-9_.,/ -]+: [^ ].*[^.]$'; then
    echo "commit subject: got '$subject', expected 'package: what changed', at most 72 characters, no final period" >&2
    exit 1
fi
