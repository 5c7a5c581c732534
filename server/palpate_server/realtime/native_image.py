"""The native image of a named tuple of arrays: one array that compiled code takes instead of the tuple.

To unbox some thirty arrays at every call costs 5 microseconds; to unbox one costs 0.1. The image is an array of words. Its one
field has the name of the tuple's type, so that functions are compiled for that type.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg, arg-type, override"
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numba import typeof, types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model
from numpy.typing import NDArray

Image = NDArray[np.void]

WORDS = 4096  # of 8 bytes: room for four hundred arrays
_TYPES: dict[str, types.Type] = {}


def register(name: str, example: tuple[Any, ...]) -> None:
    """Allow images of tuples of the same type as `example`, and give the type a name."""
    _TYPES[name] = typeof(example)


def empty_image(name: str) -> Image:
    """Room for an image of the type with this name."""
    return np.zeros(WORDS, np.dtype([(name, np.int64)]))


def _borrowed(context, builder, numba_type, value):
    """The same arrays without reference counts: the maker of the image keeps them alive."""
    if isinstance(numba_type, types.Array):
        array = context.make_array(numba_type)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()
    for i, element in enumerate(numba_type.types):
        part = builder.extract_value(value, i)
        value = builder.insert_value(value, _borrowed(context, builder, element, part), i)
    return value


def make_image(arrays: tuple[Any, ...]) -> Image:
    """The native image of a (named, nested) tuple of arrays, valid for as long as the caller keeps the arrays.

    Raises TypeError for a tuple whose type is not registered, and ValueError for one that is larger than an image may be.
    """
    numba_type = typeof(arrays)
    for name, registered in _TYPES.items():
        if registered == numba_type:
            words = list(_words(arrays))
            if len(words) > WORDS:
                raise ValueError(f"the tuple takes {len(words)} words, its image has {WORDS}")
            image = empty_image(name)
            image[name][: len(words)] = words
            return image
    raise TypeError(f"no image is registered for {type(arrays).__name__} with these types of arrays")


def _words(value: Any) -> Iterator[int]:
    """The words of an array as numba has it in memory, without reference counts; of a tuple, those of its elements.

    To have compiled code write them took a compilation of half a minute for some two hundred arrays.
    """
    if isinstance(value, tuple):
        for element in value:
            yield from _words(element)
        return
    yield from (0, 0, value.size, value.itemsize, value.ctypes.data)  # see ARRAY_MEMBERS
    yield from value.shape
    yield from value.strides


ARRAY_MEMBERS = ("meminfo", "parent", "nitems", "itemsize", "data", "shape", "strides")
"""Of numba's arrays in memory, each of one word but the last two, which have one a dimension."""


class ViewType(types.Type):
    """The address of a named tuple in an image. A field is loaded when it is read; a tuple in it is a view again.

    As a value, the tuple would be some three hundred arguments of every function that takes it: minutes to compile.
    """

    def __init__(self, tuple_type: types.BaseNamedTuple) -> None:
        self.tuple_type = tuple_type
        super().__init__(name=f"View({tuple_type})")


@register_model(ViewType)
class _ViewModel(models.PrimitiveModel):
    def __init__(self, manager, view_type) -> None:
        super().__init__(manager, view_type, cgutils.voidptr_t)


@infer_getattr
class _ViewAttributes(AttributeTemplate):
    key = ViewType

    def generic_resolve(self, view_type, name):
        if name not in view_type.tuple_type.fields:
            return None
        element = view_type.tuple_type.types[view_type.tuple_type.fields.index(name)]
        return ViewType(element) if isinstance(element, types.BaseNamedTuple) else element


@lower_getattr_generic(ViewType)
def _get_field(context, builder, view_type, value, name):
    tuple_type = view_type.tuple_type
    index = tuple_type.fields.index(name)
    pointer = builder.bitcast(value, context.get_value_type(tuple_type).as_pointer())
    field = cgutils.gep_inbounds(builder, pointer, 0, index)
    if isinstance(tuple_type.types[index], types.BaseNamedTuple):
        return builder.bitcast(field, cgutils.voidptr_t)
    return _borrowed(context, builder, tuple_type.types[index], builder.load(field, align=8))


@intrinsic
def _view(typing_context, image):
    if not isinstance(image.dtype, types.Record):
        return None
    (name,) = image.dtype.fields
    view_type = ViewType(_TYPES[name])

    def codegen(context, builder, signature, args):
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.bitcast(data, cgutils.voidptr_t)

    return view_type(image), codegen


view: Any = _view
"""For compiled code: the tuple that an image stands for, as a ViewType."""
