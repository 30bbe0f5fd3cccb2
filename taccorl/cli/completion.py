"""``taccorl completion bash|zsh|fish``: a script that completes verbs, options and files in that shell.

bash    eval "$(taccorl completion bash)"           in ~/.bashrc
zsh     eval "$(taccorl completion zsh)"            in ~/.zshrc, after compinit
fish    taccorl completion fish > ~/.config/fish/completions/taccorl.fish
"""

import ast
import shlex
from functools import cache
from pathlib import Path

from taccorl.cli.main import SECOND_WORDS, VERBS
from taccorl.errors import TaccorlError

_PACKAGE = Path(__file__).resolve().parents[1]


def main(argv: list[str]) -> int:
    """Print the script for the shell that ``argv`` names; returns the exit status 0."""
    shells = {"bash": _bash, "zsh": _zsh, "fish": _fish}
    if argv in (["-h"], ["--help"]):
        print((__doc__ or "").replace("``", ""))
        return 0
    if len(argv) != 1 or argv[0] not in shells:
        typed = " ".join(argv)
        raise TaccorlError(f"found {typed!r}; give one shell: taccorl completion {'|'.join(shells)}")
    print(shells[argv[0]]())
    return 0


def options_of(verb: str) -> list[str]:
    """Names of the options of a verb, without dashes, nested ones with a dot: ``out``, ``engine.workers``.

    They are read from the source of the config classes, because importing all of them takes seconds. If an option chooses one of
    several config classes, only the classes in the same file are included.
    """
    module = f"taccorl.cli.{verb.replace('-', '_')}"
    calls = [node for node in _nodes(module) if isinstance(node, ast.Call)]
    parsed = [call.args[0] for call in calls if isinstance(call.func, ast.Name) and call.func.id in ("parse", "verb")]
    names = [name for arg in parsed if isinstance(arg, ast.Name) for name in _field_names(module, arg.id)]
    return [*(name.rstrip("_") for name in dict.fromkeys(names)), *(["config_path"] if names else [])]


@cache
def _field_names(module: str, name: str) -> list[str]:
    """Names of the fields of the class ``name``, as ``module`` knows it, and below them those of fields that are configs."""
    module, node = _class(module, name)
    if node is None:
        return []
    names = [n for base in node.bases if isinstance(base, ast.Name) for n in _field_names(module, base.id)]
    if any(isinstance(base, ast.Attribute) and base.attr == "ChoiceRegistry" for base in node.bases):
        names.append("type")
        kinds = {name}  # and, in the order of the file, what is derived from one of them
        for n in _nodes(module):
            if isinstance(n, ast.ClassDef) and kinds & {*map(ast.unparse, n.bases)}:
                kinds.add(n.name)
                names += _own_names(module, n)
    return list(dict.fromkeys([*names, *_own_names(module, node)]))


def _own_names(module: str, node: ast.ClassDef) -> list[str]:
    names = []
    for field in node.body:
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            if ast.unparse(field.annotation).startswith("ClassVar"):
                continue
            inner = _field_names(module, field.annotation.id) if isinstance(field.annotation, ast.Name) else []
            names += [f"{field.target.id}.{name}" for name in inner] or [field.target.id]
    return names


def _class(module: str, name: str) -> tuple[str, ast.ClassDef | None]:
    """Module that defines class ``name``, which ``module`` defines or imports, and the class in its source; None if not found."""
    for node in _nodes(module):
        if isinstance(node, ast.ClassDef) and node.name == name:
            return module, node
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("taccorl."):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return _class(str(node.module), alias.name)
    return module, None


@cache
def _nodes(module: str) -> list[ast.AST]:
    """Calls, classes and imports in the module's source."""
    path = _PACKAGE.joinpath(*module.split(".")[1:])
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call | ast.ClassDef | ast.ImportFrom)]


def _verbs() -> dict[str, str]:
    return {verb: line for group in VERBS.values() for verb, line in group.items()}


def _cases(option: str) -> str:
    """A branch for each verb of a shell's ``case``: its options and second words."""
    lines = []
    for verb in _verbs():
        options = " ".join(option.format(name) for name in options_of(verb))
        lines.append(f'    {verb}) options="{options}"; words="{" ".join(SECOND_WORDS.get(verb, ()))}";;')
    return "\n".join(lines)


def _bash() -> str:
    # bash splits words at the equals sign: of --out=fo the last word is fo.
    return f"""\
_taccorl() {{
  local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} options= words=
  COMPREPLY=()
  if [[ $COMP_CWORD == 1 ]]; then
    COMPREPLY=($(compgen -W "{" ".join(_verbs())}" -- "$word"))
    return
  fi
  case ${{COMP_WORDS[1]}} in
{_cases("--{}=")}
  esac
  if [[ $word == "=" || $before == "=" ]]; then
    compopt -o filenames
    local IFS=$'\\n'
    COMPREPLY=($(compgen -f -- "${{word#=}}"))
  elif [[ $word == -* ]]; then
    compopt -o nospace
    COMPREPLY=($(compgen -W "$options" -- "$word"))
  else
    compopt -o filenames
    [[ $COMP_CWORD == 2 ]] && COMPREPLY=($(compgen -W "$words" -- "$word"))
    local IFS=$'\\n'
    COMPREPLY+=($(compgen -f -- "$word"))
  fi
}}
complete -F _taccorl taccorl"""


def _zsh() -> str:
    described = " ".join(shlex.quote(f"{verb}:{line}") for verb, line in _verbs().items())
    return f"""\
#compdef taccorl
_taccorl() {{
  local options= words_= verbs=({described})
  if (( CURRENT == 2 )); then
    _describe verb verbs
    return
  fi
  case $words[2] in
{_cases("--{}=").replace("words=", "words_=")}
  esac
  if [[ $PREFIX == --*=* ]]; then
    compset -P '*='
    _files
  elif [[ $PREFIX == -* ]]; then
    compadd -S '' -- ${{=options}}
  else
    (( CURRENT == 3 )) && compadd -- ${{=words_}}
    _files
  fi
}}
compdef _taccorl taccorl"""


def _fish() -> str:
    lines = []
    for verb, line in _verbs().items():
        lines.append(f"complete -c taccorl -n __fish_use_subcommand -f -a {verb} -d {shlex.quote(line)}")
        after = f"complete -c taccorl -n '__fish_seen_subcommand_from {verb}'"
        lines += [f"{after} -a {word}" for word in SECOND_WORDS.get(verb, ())]
        lines += [f"{after} -r -l {name}" for name in options_of(verb)]
    return "\n".join(lines)
