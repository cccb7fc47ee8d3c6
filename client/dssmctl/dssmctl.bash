# SPDX-License-Identifier: Apache-2.0
#
# bash completion for dssmctl(1): verbs, options, and the names of the streams and hosts that there
# are, as `dssmctl ls --names` and `dssmctl hosts --names` print them. Works with and without the
# bash-completion package, whose helper functions it does not need. A test compares the words below
# with `dssmctl --help`.

# What dssmctl prints for the words given here. From the command line: --socket.
_dssmctl_ask() {
  local socket=() i
  for ((i = 1; i + 1 < ${#words[@]}; ++i)); do
    [[ ${words[i]} == --socket ]] && socket=(--socket "${words[i + 1]}")
  done
  "${words[0]}" "${socket[@]}" "$@" 2>/dev/null
}

# The names that open a stream, one per line; behind an @ that is typed already, all hosts.
_dssmctl_streams() {
  _dssmctl_ask ls --names
  _dssmctl_at_hosts
}

_dssmctl_at_hosts() {
  local host typed=${cur//\\/}
  [[ $typed == *@* ]] || return 0
  while IFS= read -r host; do
    printf '%s\n' "${typed%%@*}@$host"
  done < <(_dssmctl_ask hosts --names)
}

# The fields of stream $1.
_dssmctl_fields() {
  _dssmctl_ask info --json "${1//\\/}" |
    sed -n '/"fields": \[/,/^  \]/s/^ *"name": "\(.*\)",$/\1/p'
}

# Puts those lines of standard input into COMPREPLY that begin with what is being typed, quoted
# for the shell, each once. Bash has split the word at colons and at signs: what stands before the
# last one is not to be replaced, so it is cut off.
_dssmctl_offer() {
  local line typed=${cur//\\/} before="" breaks=""
  [[ $COMP_WORDBREAKS == *:* ]] && breaks+=":"
  [[ $COMP_WORDBREAKS == *@* ]] && breaks+="@"
  [[ -n $breaks && $typed == *[$breaks]* ]] && before=${typed%"${typed##*["$breaks"]}"}
  while IFS= read -r line; do
    [[ -n $line && $line == "$typed"* ]] || continue
    printf -v line %q "${line#"$before"}"
    [[ " ${COMPREPLY[*]} " == *" $line "* ]] || COMPREPLY+=("$line")
  done
}

_dssmctl_offer_files() {
  compopt -o filenames 2>/dev/null # fails only where a test calls us by hand
  mapfile -t COMPREPLY < <(compgen -f -- "$cur")
}

_dssmctl() {
  COMPREPLY=()
  # Bash's own words, with those put together again that it split at colons and at signs.
  local words=() cword=0 i word glue=0
  for ((i = 0; i <= COMP_CWORD; ++i)); do
    word=${COMP_WORDS[i]}
    if [[ $word == [:@]* && ${#words[@]} -gt 1 ]]; then
      words[-1]+=$word
      glue=1
    elif ((glue)); then
      words[-1]+=$word
      glue=0
    else
      words+=("$word")
    fi
  done
  cword=$((${#words[@]} - 1))
  local cur=${words[cword]} prev=${words[cword - 1]}

  # The verb, how many words that are no options stand between it and the cursor, and the first one.
  local verb="" positional=0 first=""
  for ((i = 1; i < cword; ++i)); do
    case ${words[i]} in
      -r) # a value only where it is --rate
        [[ $verb != pub && $verb != play ]] || ((++i))
        ;;
      -w) # a value only where it is --window
        [[ $verb != hz && $verb != bw && $verb != delay ]] || ((++i))
        ;;
      --socket | --sort | --host | --at | --count | -n | -c | --field | --wait | --window | \
        --interval | -i | --every | --view | --size | --table | --depth | --life | --cycle | --type | --align | --offset | \
        --speed | --time | --rate | --ca | --credentials | --out | --name | --program | --days | \
        --output | -o | --past | --span | --until | --for | --compression | --max-file-size | \
        --max-file-duration | --max-total-size | --from | --to | --map | --lockstep | --before | \
        --after | --trigger | --min-interval | --max-incident | --quota | --reason | --config | --repair | \
        --stream)
        ((++i))
        ;;
      -*) ;;
      *)
        case $verb in
          "") verb=${words[i]} ;;
          property | playback | pki | help) verb+=" ${words[i]}" ;;
          *)
            ((positional++)) || first=${words[i]}
            ;;
        esac
        ;;
    esac
  done

  if [[ $verb == describe && $prev == --from ]]; then
    _dssmctl_offer_files
    return
  fi
  case $prev in
    --socket | --ca | --credentials | --out | --output | -o | --config | --repair)
      _dssmctl_offer_files
      return
      ;;
    --sort)
      if [[ $verb == top ]]; then
        mapfile -t COMPREPLY < <(compgen -W "age clock created cycle depth found host id memory \
          name pid program rate readers reads rtt size state streams type writers writes" -- "$cur")
        return
      fi
      mapfile -t COMPREPLY < <(compgen -W "created name id host size depth cycle rate age writers \
        readers type memory" -- "$cur")
      return
      ;;
    --stream) return ;; # of a recording
    --host)
      _dssmctl_offer < <(_dssmctl_ask hosts --names)
      return
      ;;
    --view)
      mapfile -t COMPREPLY < <(compgen -W "hosts programs streams" -- "$cur")
      return
      ;;
    --compression)
      mapfile -t COMPREPLY < <(compgen -W "lz4 none zstd" -- "$cur")
      return
      ;;
    --field)
      _dssmctl_offer < <(_dssmctl_fields "$first")
      return
      ;;
    --at | --count | -n | -c | --wait | --window | --interval | -i | --every | --size | --table | \
      --depth | --life | --cycle | --type | --align | --offset | --speed | --time | --rate | --name | \
      --program | --days | --past | --until | --for | --max-file-size | --max-file-duration | \
      --max-total-size | --from | --to | --map | --before | --after | --trigger | --min-interval | \
      --max-incident | --quota | --reason)
      return # a value that only the person knows
      ;;
  esac

  local common="--help --iso --json --socket --wide" options=""
  case $verb in
    "") options="--version" ;;
    ls) options="--host --local --names --own --reverse --sort --watch" ;;
    hosts) options="--names --watch" ;;
    nodes) options="--host" ;;
    top) options="--count --every --interval --reverse --sort --view" ;;
    graph) options="--out" ;;
    info) options="--watch" ;;
    clock) options="--matrix --table --wait --watch" ;;
    ping) options="--count --interval" ;;
    plot) options="--for --out --span --wait" ;;
    echo) options="--at --count --csv --field --full --last --wait" ;;
    pub) options="--count --rate --stdin --times" ;;
    play) options="--force --from --lockstep --loop --map --now --on-hosts --rate --start-paused --this-host --to" ;;
    record)
      options="--after --before --black-box --compression --config --follow --for --host \
        --max-file-duration --max-file-size --max-incident --max-total-size --min-interval --output \
        --past --quota --repair --trigger --type --until"
      ;;
    trigger) options="--reason" ;;
    hz | bw | delay) options="--count --interval --wait --window" ;;
    convert) options="--compression --stream" ;;
    describe) options="--force --from --type" ;;
    create) options="--align --cycle --depth --life --size --type" ;;
    "playback set") options="--offset --speed --time" ;;
    "pki init") options="--ca --name" ;;
    "pki request") options="--credentials --host --out --program" ;;
    "pki issue" | "pki renew") options="--ca --days --out" ;;
    "pki revoke") options="--ca --out" ;;
    "pki install") options="--credentials" ;;
  esac
  if [[ $cur == -* ]]; then
    local option given=" ${words[*]:1:cword-1} " left=""
    for option in $common $options; do # without those that are given and count only once
      [[ $option != --host && $option != --field && $given == *" $option "* ]] || left+=" $option"
    done
    mapfile -t COMPREPLY < <(compgen -W "$left" -- "$cur")
    return
  fi

  case ${verb#help } in
    "" | help)
      mapfile -t COMPREPLY < <(compgen -W \
        "bw clock convert create delay describe doctor echo find graph hosts hz info ls metrics nodes ping pki \
          play playback plot property pub record rights rm show top trigger" -- "$cur")
      ;;
    property) mapfile -t COMPREPLY < <(compgen -W "get set" -- "$cur") ;;
    playback) mapfile -t COMPREPLY < <(compgen -W "pause reset resume set show" -- "$cur") ;;
    pki)
      mapfile -t COMPREPLY < <(compgen -W "init install issue renew request revoke show" -- "$cur")
      ;;
    "pki issue" | "pki install" | "pki show") ((positional == 0)) && _dssmctl_offer_files ;;
    play) ((positional == 0)) && _dssmctl_offer_files ;;
    convert) _dssmctl_offer_files ;;
    ping) ((positional == 0)) && _dssmctl_offer < <(_dssmctl_ask hosts --names) ;;
    create) ((positional == 0)) && _dssmctl_offer < <(_dssmctl_at_hosts) ;;
    rm | hz | bw | delay | record) _dssmctl_offer < <(_dssmctl_streams) ;;
    info | echo | pub | rights | describe)
      ((positional == 0)) && _dssmctl_offer < <(_dssmctl_streams)
      ;;
    "property get" | "property set")
      if ((positional == 0)); then
        _dssmctl_offer < <(_dssmctl_streams)
      elif ((positional == 1)); then
        _dssmctl_offer_files
      fi
      ;;
  esac
  return 0
}

complete -F _dssmctl dssmctl
