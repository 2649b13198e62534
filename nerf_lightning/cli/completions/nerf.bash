# Completion of nerf for bash. In ~/.bashrc:  eval "$(nerf completion bash)"
_nerf_complete() {
    local line=${COMP_LINE:0:COMP_POINT} current kept
    local -a words found
    read -ra words <<< "$line"
    [[ $line == *[[:space:]] ]] && words+=("")
    current=${words[${#words[@]} - 1]}
    local IFS=$'\n'
    found=($("${words[0]}" completion candidates "${words[@]:1}" 2> /dev/null))
    # Readline takes these signs for the ends of words, and replaces what stands behind the last one alone.
    kept=${current%"${current##*[=:@]}"}
    COMPREPLY=("${found[@]#"$kept"}")
    [[ ${found[0]} == *[=./] ]] && compopt -o nospace 2> /dev/null
    return 0
}
complete -F _nerf_complete nerf
