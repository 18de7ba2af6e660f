// From the server's geometry to three.js objects. World frame: z up, metres; matrices column by column.

/** The viewer's own three.js, so that there is one. */
export const three = () => window.MeshCat.THREE;

const QUARTER = Math.PI / 2;
const made = new Map(); // shapes, shared by the robot and its ghosts

/** The value of a custom property where the page stands now. */
export function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** One geometry for all shapes of a kind and size: box (x, y, z), sphere (radius), cylinder along z (radius, length). */
export function shape(kind, size) {
  const key = `${kind} ${size}`;
  if (!made.has(key)) made.set(key, newShape(kind, size));
  return made.get(key);
}

function newShape(kind, size) {
  const THREE = three();
  if (kind === "box") return new THREE.BoxGeometry(...size);
  if (kind === "sphere") return new THREE.SphereGeometry(size[0], 24, 16);
  if (kind === "cylinder") return new THREE.CylinderGeometry(size[0], size[0], size[1], 28).rotateX(QUARTER); // three's stand along y
  throw new Error(`shape ${kind}; known: box, sphere, cylinder`);
}

/** A material of red, green, blue and opacity, 0 to 1. */
export function material([red, green, blue, alpha = 1]) {
  const THREE = three();
  const colour = new THREE.Color(red, green, blue);
  return new THREE.MeshPhongMaterial({ color: colour, specular: 0x222222, shininess: 30, transparent: alpha < 1, opacity: alpha });
}

/** A robot that is not the real one: seen through, and never hiding what is measured unless it is `solid`. */
export function ghostPaint({ colour, opacity, solid = false }) {
  const THREE = three();
  // Behind the real robot where both are in the same place: blue is what differs.
  const look = { color: colour, transparent: true, opacity, depthWrite: solid, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 };
  return solid ? new THREE.MeshPhongMaterial({ ...look, specular: 0x222222, shininess: 30 }) : new THREE.MeshBasicMaterial(look);
}
