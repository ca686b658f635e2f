"""
A first mesh
============

Two stiff spheres in a soft block, meshed with 800 nodes.
"""

import tetopt

image = tetopt.load_phantom("two_spheres").image(voxel_mm=2.0)
result = tetopt.mesh_image(image, nodes=800)
share = tetopt.E_D(image, result.mesh) / (image.data.var() * image.volume)
print(f"{share:.4f} of the variance is left inside the cells")
