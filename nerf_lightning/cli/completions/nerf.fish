# Completion of nerf for fish. Once:  nerf completion fish > ~/.config/fish/completions/nerf.fish
function __nerf_complete
    set -l words (commandline -opc)
    set -l current (commandline -ct)
    $words[1] completion candidates $words[2..-1] "$current" 2>/dev/null
end
complete -c nerf -f -a '(__nerf_complete)'
