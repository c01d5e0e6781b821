"""The viewer: a page in which the kernels run as WebAssembly, and a server that shows it on the own machine.

The page is a file (:mod:`nerfvol.export.page`): style and scripts in this folder, ``kernels.wasm`` made by ``make wasm``, the
model itself. docs/viewer.md says how it works.
"""
