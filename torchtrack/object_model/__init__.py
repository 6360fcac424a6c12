"""Object models: what the tracker knows of an object's shape and print.

A model is read once, checked, and turned into plain tensors in metres in the object's own frame:

==================  ===========================================================================
``surface.py``      meshes welded by position, with texture coordinates and colours per corner
``loading.py``      PLY, OBJ, STL, GLB and OFF through trimesh; files that cannot be used
``placement.py``    units, scale and origin
``gltf.py``         checks before trimesh reads a glTF file, and what it would misread made plain (``gltf_accessors.py``)
``obj.py``          the same for OBJ and its material libraries
``ply.py``          the same for PLY
``stl_off.py``      the same for STL and OFF
``side_files.py``   files beside a model, by the names that tools give them
``textures.py``     images of any kind as 8-bit RGB; textures that are lost are told
``winding.py``      faces turned to the outside
``mesh_edges.py``   the mesh edges that can ever be a contour
``texture_edges.py``  edges of a printed texture, carried to the surface through its UV map
``colour_edges.py`` edges where the colours of faces or vertices change
``sampling.py``     even samples of a surface
``polylines.py``    models that are 3D line segments and nothing else
``model.py``        :class:`ObjectModel`, which puts them together
``report.py``       what can be said of a model before it is tracked
==================  ===========================================================================
"""

from torchtrack.object_model.model import ObjectModel
from torchtrack.object_model.settings import ModelSettings

__all__ = ["ModelSettings", "ObjectModel"]
