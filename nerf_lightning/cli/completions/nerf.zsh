#compdef nerf
# Completion of nerf for zsh. In ~/.zshrc:  eval "$(nerf completion zsh)"
_nerf_complete() {
    local -a found
    found=("${(@f)$("${words[1]}" completion candidates "${(@)words[2,CURRENT]}" 2> /dev/null)}")
    local -a ended=(${found:#*[=./]}) going_on=(${(M)found:#*[=./]})
    compadd -Q -a ended
    compadd -Q -S '' -a going_on
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _nerf_complete nerf
