"""A sequence of unrelated meshes: one skeleton with consistent tips, lengths and angles over time as a table.

python examples/spine_of_sequence.py [FRAMES...]     # without arguments on a made-up starfish
"""

import sys

import torchreg as tr
from torchreg.datasets.creatures import STARFISH, creature_sequence

if len(sys.argv) > 1:
    meshes = [tr.load_mesh(name) for name in sys.argv[1:]]
else:
    meshes = list(creature_sequence(STARFISH, 4, resolution=56).meshes)
print(f"{len(meshes)} frames of {min(mesh.num_vertices for mesh in meshes)} vertices and more")

spine = tr.extract_spine(meshes, workers=1)
print(f"{spine.num_tips} tips, {len(spine.graph)} limbs; upright: {spine.up}")
print(f"least probability of a name: {spine.confidence.min():.2f}; {len(spine.warnings)} warnings")

found = spine.measurements()
spread = found.lengths.std(0) / found.lengths.mean(0)
print("lengths:", [f"{length:.2f}" for length in found.lengths.mean(0).tolist()], f"constant to {spread.max():.0%}")
print("between two frames:", tuple(spine.model(0.5).shape))

found.save_csv("limbs.csv")
spine.save("spine.safetensors")
spine.plot(meshes).figure.savefig("spine_of_sequence.png")
