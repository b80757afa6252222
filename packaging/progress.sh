# shellcheck shell=bash
# Sourced by scripts. `progress NAME COMMAND...` runs a command and prints its build steps, and at least every
# PROGRESS_S (5) seconds its last line, each with the elapsed time. If the command fails, it prints the last
# FAILURE_LINES (20) lines and returns the command's status.

progress() {
    local name=$1 log status=0
    shift
    log=$(mktemp)
    "$@" 2>&1 | _show_progress "$name" "$log" || status=$?
    if [ "$status" != 0 ]; then
        tail -n "${FAILURE_LINES:-20}" "$log" | sed "s/^/$name: /" >&2
    fi
    rm -f "$log"
    return "$status"
}

_show_progress() {
    local name=$1 log=$2 line='' last='started' started=$SECONDS printed=-1000 status
    while true; do
        status=0
        IFS= read -r -t "${PROGRESS_S:-5}" line || status=$?
        # Above 128: no line within the time. Otherwise not 0: the end.
        if [ "$status" != 0 ] && [ "$status" -le 128 ]; then return 0; fi
        if [ "$status" = 0 ]; then
            printf '%s\n' "$line" >>"$log"
            line=${line##*$'\r'}
            line=${line//$'\e[0m'/}
            [ -z "${line// /}" ] || last=${line:0:100}
        fi
        # Steps of docker's builders: "Step 3/20 : RUN ..." and "#7 [build 2/5] RUN ...".
        if [[ $status != 0 || $line =~ ^(Step\ |\#[0-9]+\ \[) ]] || ((SECONDS - printed >= ${PROGRESS_S:-5})); then
            echo "$name: $((SECONDS - started)) s: $last"
            printed=$SECONDS
        fi
    done
}
