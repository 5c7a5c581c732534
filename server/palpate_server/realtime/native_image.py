"""Hand a named tuple of arrays to compiled code as one array: its native image, unboxed once instead of at every call.

Unboxing some thirty arrays costs 5 microseconds; unboxing one costs a tenth of one. The image is an array of words whose
one field bears the name of the tuple's type, so that compiled code is compiled for that type.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg, arg-type, override"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import typeof, types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled

Image = NDArray[np.void]

WORDS = 1024  # of 8 bytes: room for a hundred arrays
_TYPES: dict[str, types.Type] = {}


def register(name: str, example: tuple[Any, ...]) -> None:
    """Have images of tuples like `example` be made and viewed, under a name of their own."""
    _TYPES[name] = typeof(example)


def empty_image(name: str) -> Image:
    """An array to copy images of the type of this name into."""
    return np.zeros(WORDS, np.dtype([(name, np.int64)]))


def _borrowed(context, builder, numba_type, value):
    """The same arrays without an owner to count references on: whoever made the image keeps them alive."""
    if isinstance(numba_type, types.Array):
        array = context.make_array(numba_type)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()
    for i, element in enumerate(numba_type.types):
        part = builder.extract_value(value, i)
        value = builder.insert_value(value, _borrowed(context, builder, element, part), i)
    return value


def _pointer_to(context, builder, buffer_type, buffer, numba_type):
    data = context.make_array(buffer_type)(context, builder, buffer).data
    return builder.bitcast(data, context.get_value_type(numba_type).as_pointer())


@intrinsic
def _store(typing_context, buffer, value):
    def codegen(context, builder, signature, args):
        native = context.get_value_type(signature.args[1])
        if context.get_abi_sizeof(native) > 8 * WORDS:
            raise ValueError("the tuple is larger than its image may be")
        builder.store(
            _borrowed(context, builder, signature.args[1], args[1]),
            _pointer_to(context, builder, signature.args[0], args[0], signature.args[1]),
            align=8,
        )
        return context.get_dummy_value()

    return types.void(buffer, value), codegen


@compiled
def _write(buffer: Image, value: tuple[Any, ...]) -> None:
    _store(buffer, value)


def make_image(arrays: tuple[Any, ...]) -> Image:
    """The native image of a (named, nested) tuple of arrays, valid for as long as the caller keeps the arrays.

    Raises TypeError for a tuple whose type is not registered.
    """
    numba_type = typeof(arrays)
    for name, registered in _TYPES.items():
        if registered == numba_type:
            image = empty_image(name)
            _write(image, arrays)
            return image
    raise TypeError(f"no image is registered for {type(arrays).__name__} with these types of arrays")


class ViewType(types.Type):
    """A named tuple in an image, by its address: a field is loaded when it is asked for, and a tuple in it is a view again.

    A whole tuple as a value would be some three hundred arguments of every function that it is handed to, which takes
    minutes to compile.
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
