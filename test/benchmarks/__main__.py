"""``python test/benchmarks NAME …`` runs a benchmark; without a name, what there are."""

import ast
from importlib import import_module
from pathlib import Path
import sys


def main():
    """Run the benchmark of that name; its exit status is 1 where a bound is missed."""
    titles = {}
    for path in sorted(Path(__file__).parent.glob('*.py')):
        text = path.read_text(encoding='utf-8')
        if 'def main()' in text and path.stem != '__main__':
            titles[path.stem] = str(ast.get_docstring(ast.parse(text))).splitlines()[0]
    if len(sys.argv) < 2 or sys.argv[1] not in titles:
        print('python test/benchmarks NAME …, each with its own --help\n')
        print('\n'.join(f'  {name:18}{title}' for name, title in titles.items()))
        return 2
    name = sys.argv.pop(1)
    sys.argv[0] += f' {name}'
    # What benchmarks share with the tests.
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    return int(import_module(name).main())


if __name__ == '__main__':
    sys.exit(main())
