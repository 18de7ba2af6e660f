// The joints of a robot as a list to choose from, group by group.

/** Options of value 0, 1, ... for `names`, "group.joint" each; several groups are told apart by headings. */
export function jointOptions(names) {
  const groups = new Map();
  names.forEach((name, index) => {
    const group = name.split(".", 1)[0];
    if (!groups.has(group)) groups.set(group, []);
    groups.get(group).push(new Option(name, String(index)));
  });
  if (groups.size < 2) return [...groups.values()].flat();
  return [...groups].map(([name, options]) => {
    const heading = document.createElement("optgroup");
    heading.label = name.replaceAll("_", " ");
    heading.append(...options);
    return heading;
  });
}
