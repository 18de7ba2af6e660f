// The parts of a robot as groups of shapes, placed by the server's matrices.

import { exchange } from "./scene_meshes.js";
import { material, shape, three } from "./scene_shapes.js";

export const SIZE = 16; // numbers of a matrix

/** Give `groups` the matrices in `numbers` that begin at index `from`. */
export function place(groups, numbers, from) {
  groups.forEach((group, index) => {
    group.matrix.fromArray(numbers, from + index * SIZE);
    group.matrixWorldNeedsUpdate = true;
  });
}

/**
 * Return one group per part, whose matrix is set by `place`. `paint` overrides the colours. Meshes are boxes until `meshes` has
 * loaded them; `changed(object)` is called for each.
 */
export function robotParts({ parts, visuals }, { meshes, changed, paint = null }) {
  const THREE = three();
  const groups = parts.map(() => {
    const group = new THREE.Group();
    group.matrixAutoUpdate = false;
    return group;
  });
  const painted = paint && paint();
  for (const visual of visuals) {
    const { kind, size, origin } = visual.box ?? visual;
    const mesh = new THREE.Mesh(shape(kind, size), painted ?? material(visual.colour));
    mesh.matrixAutoUpdate = false;
    mesh.matrix.fromArray(origin);
    groups[visual.part].add(mesh);
    if (visual.address) exchange(meshes, visual, mesh, painted, changed);
  }
  return groups;
}
