// The capsules that represent the robot's links when collisions are checked.

import { shape, three } from "./scene_shapes.js";

const LOOK = { color: "#f5b642", transparent: true, opacity: 0.26, depthWrite: false };

export class Capsules {
  #capsules; // [{part, start, end, radius}] from the server
  #objects;

  /** `add(path, object)` puts an object into the scene. */
  constructor(capsules, add) {
    const look = new (three().MeshBasicMaterial)(LOOK);
    this.#capsules = capsules;
    this.#objects = capsules.map((capsule, index) => add(`capsules/${index}`, drawn(capsule, look)));
    this.show(false);
  }

  show(shown) {
    for (const object of this.#objects) object.visible = shown;
  }

  /** Move the capsules with the robot's `parts` (its groups). */
  move(parts) {
    this.#capsules.forEach(({ part }, index) => {
      this.#objects[index].matrix.copy(parts[part].matrix);
      this.#objects[index].matrixWorldNeedsUpdate = true;
    });
  }
}

/** Return a capsule: a cylinder between two spheres. */
function drawn({ start, end, radius }, look) {
  const THREE = three();
  const group = new THREE.Group();
  group.matrixAutoUpdate = false;
  const [from, to] = [new THREE.Vector3(...start), new THREE.Vector3(...end)];
  const length = from.distanceTo(to);
  for (const at of length > 1e-6 ? [from, to] : [from]) {
    const ball = new THREE.Mesh(shape("sphere", [radius]), look);
    ball.position.copy(at);
    group.add(ball);
  }
  if (length > 1e-6) {
    const tube = new THREE.Mesh(shape("cylinder", [radius, length]), look);
    tube.position.copy(from).lerp(to, 0.5);
    tube.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), to.sub(from).normalize());
    group.add(tube);
  }
  return group;
}
