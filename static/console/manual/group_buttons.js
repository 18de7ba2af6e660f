// Buttons for the groups of a robot's joints, one of which is chosen.

import { t } from "../../site/sentences.js";

/** Return a button for each of `groups`; the button of the next group shows the key that chooses it. */
export function groupButtons(groups, chosen) {
  const next = (chosen + 1) % groups.length;
  return groups.map(({ name }, index) => groupButton(name, index, chosen, next));
}

function groupButton(name, index, chosen, next) {
  const button = document.createElement("button");
  Object.assign(button, { type: "button", className: "segment" });
  button.dataset.group = index;
  button.setAttribute("aria-pressed", String(index === chosen));
  const text = document.createElement("span");
  text.textContent = name.replaceAll("_", " ");
  button.append(text);
  if (index !== next || next === chosen) return button;
  Object.assign(button.dataset, { key: "shift+a", keyText: t("page.manual.next_group", "Next group of joints") });
  const cap = document.createElement("kbd");
  cap.textContent = "⇧A";
  button.append(" ", cap);
  return button;
}
