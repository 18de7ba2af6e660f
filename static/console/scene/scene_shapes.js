// Conversion of the server's geometry into three.js objects. World frame: metres, z up; matrices column by column.

/** Return the viewer's own three.js, so that only one copy is in use. */
export const three = () => window.MeshCat.THREE;

const QUARTER = Math.PI / 2;
const made = new Map(); // geometries, shared by the robot and its ghosts

/**
 * Return the one geometry for all shapes of a kind and size: box (x, y, z), sphere (radius), cylinder along z (radius, length).
 */
export function shape(kind, size) {
  const key = `${kind} ${size}`;
  if (!made.has(key)) made.set(key, newShape(kind, size));
  return made.get(key);
}

function newShape(kind, size) {
  const THREE = three();
  if (kind === "box") return new THREE.BoxGeometry(...size);
  if (kind === "sphere") return new THREE.SphereGeometry(size[0], 24, 16);
  if (kind === "cylinder") return new THREE.CylinderGeometry(size[0], size[0], size[1], 28).rotateX(QUARTER); // cylinders of three.js are along y
  throw new Error(`shape ${kind}; known: box, sphere, cylinder`);
}

/** Return a material with red, green, blue and opacity, each 0 to 1. */
export function material([red, green, blue, alpha = 1]) {
  const THREE = three();
  const colour = new THREE.Color(red, green, blue);
  return new THREE.MeshPhongMaterial({ color: colour, specular: 0x222222, shininess: 30, transparent: alpha < 1, opacity: alpha });
}

/** Return the material of a ghost: translucent, and never hiding the measured robot unless it is `solid`. */
export function ghostPaint({ colour, opacity, solid = false }) {
  const THREE = three();
  // The offset puts a ghost behind the real robot where both coincide, so that blue shows only differences.
  const look = { color: colour, transparent: true, opacity, depthWrite: solid, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 };
  return solid ? new THREE.MeshPhongMaterial({ ...look, specular: 0x222222, shininess: 30 }) : new THREE.MeshBasicMaterial(look);
}
