# SPDX-License-Identifier: Apache-2.0
#
# fish completion for dssmctl(1). Verbs and options come from its help texts; names of streams and
# hosts from `dssmctl ls --names` and `dssmctl hosts --names`, fields from `dssmctl info --json`.

function __dssmctl_ask
    set -l words (commandline -opc)
    set -l socket
    if set -l at (contains -i -- --socket $words)
        set socket --socket $words[(math $at + 1)]
    end
    command $words[1] $socket $argv 2>/dev/null
end

# The names that open a stream; after an @ all hosts, too.
function __dssmctl_streams
    __dssmctl_ask ls --names
    __dssmctl_at_hosts
end

function __dssmctl_at_hosts
    set -l name (commandline -ct)
    string match -q '*@*' -- $name; or return 0
    __dssmctl_ask hosts --names | string replace -r '^' (string replace -r '@.*' '@' -- $name)
end

function __dssmctl_candidates
    set -l words (commandline -opc)
    set -l verb
    set -l positional
    set -l i 2
    while test $i -le (count $words)
        switch $words[$i]
            case -w
                # A value only where it is --window.
                contains -- "$verb" hz bw delay; and set i (math $i + 1)
            case -r
                # A value only where it is --rate.
                contains -- "$verb" pub play; and set i (math $i + 1)
            case --socket --sort --host --at --count -n -c --field --wait --window --interval -i \
                --every --view --size --table --depth --life --cycle --type --align --offset --speed --time --rate --ca \
                --credentials --out --name --program --days --output -o --past --span --until --for \
                --compression --max-file-size --max-file-duration --max-total-size --from --to --map \
                --before --after --trigger --min-interval --max-incident --quota --reason --config \
                --lockstep --repair --stream
                set i (math $i + 1)
            case '-*'
            case '*'
                if test (count $verb) -eq 0
                    set verb $words[$i]
                else if test (count $verb) -eq 1; and contains -- $verb property playback pki help
                    set -a verb $words[$i]
                else
                    set -a positional $words[$i]
                end
        end
        set i (math $i + 1)
    end

    if test "$verb" = describe -a "$words[-1]" = --from
        __fish_complete_path (commandline -ct)
        return
    end
    switch $words[-1]
        case --stream # of a recording
            return
        case --socket --ca --credentials --out --output -o --config --repair
            __fish_complete_path (commandline -ct)
            return
        case --host
            __dssmctl_ask hosts --names
            return
        case --field
            __dssmctl_ask info --json $positional[1] |
                sed -n '/"fields": \[/,/^  \]/s/^ *"name": "\(.*\)",$/\1/p'
            return
        case --view
            printf '%s\n' hosts programs streams
            return
        case --sort
            if test "$verb" = top
                printf '%s\n' age clock created cycle depth found host id memory name pid program \
                    rate readers reads rtt size state streams type writers writes
                return
            end
            printf '%s\n' created name id host size depth cycle rate age writers readers type memory
            return
        case --at --count -n -c --wait --window --interval -i --every --size --table --depth --life --cycle \
            --type --align --offset --speed --time --rate --name --program --days --past --until --for \
            --max-file-size --max-file-duration --max-total-size --from --to --map --before --after \
            --trigger --min-interval --max-incident --quota --reason
            return
        case --compression
            printf '%s\n' lz4 none zstd
            return
    end

    if string match -q -- '-*' (commandline -ct)
        # The options of all verbs are in the help without one.
        set -l options --version
        set -q verb[1]; and set options (__dssmctl_ask $verb --help)
        printf '%s\n' $options (__dssmctl_ask --help | string match -v '  --version*') |
            sed -n 's/^ *\(-[a-z],\)*\(--[a-z-]*\).*/\2/p' | sort -u | while read -l option
                # Without those that are given and count only once.
                contains -- $option $words; and not contains -- $option --host --field
                or echo $option
            end
        return
    end
    switch "$verb"
        case '' help property playback pki
            __dssmctl_ask (string match -v help -- $verb) --help |
                sed -n '/^Subcommands:/,$s/^  \([a-z]\{1,\}\)  *\(.*\)/\1\t\2/p'
        case ping
            test (count $positional) -eq 0; and __dssmctl_ask hosts --names
        case create
            test (count $positional) -eq 0; and __dssmctl_at_hosts
        case hz bw delay rm record
            __dssmctl_streams
        case info echo pub rights describe
            test (count $positional) -eq 0; and __dssmctl_streams
        case 'property get' 'property set'
            switch (count $positional)
                case 0
                    __dssmctl_streams
                case 1
                    __fish_complete_path (commandline -ct)
            end
        case convert
            __fish_complete_path (commandline -ct)
        case play 'pki issue' 'pki install' 'pki show'
            test (count $positional) -eq 0; and __fish_complete_path (commandline -ct)
    end
end

complete -c dssmctl -f -a '(__dssmctl_candidates)'
