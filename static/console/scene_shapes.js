// From the server's geometry to three.js objects. World frame: z up, metres; matrices column by column.

/** The viewer's own three.js, so that there is one. */
export const three = () => window.MeshCat.THREE;

const QUARTER = Math.PI / 2;
export const SIZE = 16; // numbers of a matrix
const made = new Map(); // shapes, shared by the robot and its ghosts

/** The value of a custom property where the page stands now. */
export function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Put `groups` at matrices that begin at `from` in `numbers`. */
export function place(groups, numbers, from) {
  groups.forEach((group, index) => {
    group.matrix.fromArray(numbers, from + index * SIZE);
    group.matrixWorldNeedsUpdate = true;
  });
}

function shape(kind, size) {
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

function material([red, green, blue, alpha = 1]) {
  const THREE = three();
  const colour = new THREE.Color(red, green, blue);
  return new THREE.MeshPhongMaterial({ color: colour, specular: 0x222222, shininess: 30, transparent: alpha < 1, opacity: alpha });
}

/** One group per part, its matrix free to be set; `paint` overrides the colours. */
export function robotParts({ parts, visuals }, paint = null) {
  const THREE = three();
  const groups = parts.map(() => {
    const group = new THREE.Group();
    group.matrixAutoUpdate = false;
    return group;
  });
  const painted = paint && paint();
  for (const visual of visuals) {
    const mesh = new THREE.Mesh(shape(visual.kind, visual.size), painted ?? material(visual.colour));
    mesh.matrixAutoUpdate = false;
    mesh.matrix.fromArray(visual.origin);
    groups[visual.part].add(mesh);
  }
  return groups;
}

/** A robot that is not the real one: seen through, and never hiding what is measured unless it is `solid`. */
export function ghostPaint({ colour, opacity, solid = false }) {
  const THREE = three();
  // Behind the real robot where both are in the same place: blue is what differs.
  const look = { color: colour, transparent: true, opacity, depthWrite: solid, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 };
  return solid ? new THREE.MeshPhongMaterial({ ...look, specular: 0x222222, shininess: 30 }) : new THREE.MeshBasicMaterial(look);
}

/** Where the arms are mounted; its surface is z = 0. */
export function table({ centre, size, thickness, colour }) {
  const THREE = three();
  const mesh = new THREE.Mesh(new THREE.BoxGeometry(size[0], size[1], thickness), material(colour));
  mesh.position.set(centre[0], centre[1], -thickness / 2 - 0.001);
  return mesh;
}

/** A flat plate around its own middle, standing on z = 0. */
export function plate({ plate_radius: radius, plate_height: height, plate_colour: colour, plate_rim_colour: rim }) {
  const THREE = three();
  const group = new THREE.Group();
  const dish = new THREE.Mesh(shape("cylinder", [radius * 0.86, height]), material(colour));
  const edge = new THREE.Mesh(shape("cylinder", [radius, height * 0.8]), material(rim));
  dish.position.z = height / 2 + 0.0005;
  edge.position.z = (height * 0.8) / 2;
  group.add(edge, dish);
  return group;
}

/** The block number `index`, around its own middle. */
export function block({ block_edge: edge, block_colours: colours }, index) {
  const THREE = three();
  return new THREE.Mesh(new THREE.BoxGeometry(edge, edge, edge), material(colours[index % colours.length]));
}
