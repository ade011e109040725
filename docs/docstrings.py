"""How docstrings of this project are read for the reference of the API; an extension of griffe (see mkdocs.yml)."""

import re
from typing import Any

from griffe import Class, Extension, Object

SEVERAL = re.compile(r"^( +)(\w+(?:, \w+)+):(.*(?:\n\1 +\S.*)*)", re.MULTILINE)


class Docstrings(Extension):
    """What is explained for several names at once is shown for each, and attributes of a class only once."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Write `a, b: text` as two entries, with the same text."""
        if obj.docstring:
            obj.docstring.value = SEVERAL.sub(
                lambda match: "\n".join(f"{match[1]}{name}:{match[3]}" for name in match[2].split(", ")),
                obj.docstring.value,
            )

    def on_class(self, *, cls: Class, **kwargs: Any) -> None:
        """Leave out attributes that the class's own docstring explains."""
        if cls.docstring and "\nAttributes:\n" in cls.docstring.value:
            for name in [name for name, member in cls.members.items() if member.is_attribute]:
                if not cls.members[name].has_docstring:
                    cls.del_member(name)
