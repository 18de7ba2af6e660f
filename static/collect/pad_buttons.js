// The buttons of gamepads as presses: of a button that went down while we looked, never of one that was held before.
// A pedal is a keyboard: its key can stand in the place of a button.

import { t } from "../site/sentences.js";

/** What can be pressed by a pad, and which button does it as delivered (numbers of the standard mapping). */
export const ACTIONS = {
  arm: { name: t("page.pads.arm", "Arm, disarm"), button: 9 },
  big: { name: t("page.pads.big", "Start; stop and save"), button: 0 },
  discard: { name: t("page.pads.discard", "Discard"), button: 1 },
  rerecord: { name: t("page.pads.rerecord", "Re-record"), button: 3 },
  success: { name: t("page.pads.success", "Success"), button: 12 },
  partial: { name: t("page.pads.partial", "Partial"), button: 15 },
  fail: { name: t("page.pads.fail", "Fail"), button: 13 },
};

const NAMES = ["A", "B", "X", "Y", "LB", "RB", "LT", "RT", "Back", "Start", t("page.pads.left_stick", "left stick"), t("page.pads.right_stick", "right stick"), t("page.pads.up", "up"), t("page.pads.down", "down"), t("page.pads.left", "left"), t("page.pads.right", "right"), "Guide"];

/** A button as it stands on a pad of the standard mapping, else its number; a key by its name. */
export function buttonName(button, mapping) {
  if (button === null || button === undefined) return t("page.pads.none", "none");
  if (typeof button === "string") return t("page.pads.key", "key {key}", { key: button.length === 1 ? button.toUpperCase() : button });
  return mapping === "standard" && NAMES[button] ? `${NAMES[button]} (${button})` : t("page.pads.button", "button {button}", { button });
}

export function defaultMapping() {
  return Object.fromEntries(Object.entries(ACTIONS).map(([action, { button }]) => [action, button]));
}

/** Why a key cannot be that of a pedal, "" where it can; `taken` are the keys that the page has. */
export function whyNotKey(key, taken) {
  if (key === " " || key === "Escape") return t("page.pads.is_estop", "{key} is the e-stop", { key: key === " " ? "Space" : "Esc" });
  if (/^(Tab|Shift|Control|Alt|Meta|AltGraph|CapsLock|Dead|Process|Unidentified)$/.test(key)) return t("page.pads.alone", "{key} alone cannot be assigned", { key });
  return taken.includes(key.toLowerCase()) || key === "?" ? t("page.pads.used", "the page already uses {key}", { key }) : "";
}

/** `mapping` with `action` on `button`, or on a key; whatever was on that before is on none. */
export function withAssignment(mapping, action, button) {
  const freed = Object.entries(mapping).map(([other, at]) => [other, at === button ? null : at]);
  return { ...Object.fromEntries(freed), [action]: button };
}

/** What was kept, as far as it is a mapping; the delivered one for the rest. */
export function parseMapping(text) {
  let kept = {};
  try {
    kept = JSON.parse(text ?? "{}") ?? {};
  } catch {
    kept = {};
  }
  const fits = (at) => at === null || (Number.isInteger(at) && at >= 0 && at < 64) || (typeof at === "string" && at !== "" && !whyNotKey(at, []));
  return Object.fromEntries(Object.entries(defaultMapping()).map(([action, at]) => [action, fits(kept[action]) ? kept[action] : at]));
}

/** Follows pads from look to look. */
export class Presses {
  #held = new Map(); // index -> {id, buttons}

  /** The buttons that went down since the last look: [{pad, button}]. A pad that is new, or another, only begins. */
  look(pads) {
    const pressed = [];
    const there = new Set();
    for (const pad of pads) {
      if (!pad?.connected) continue;
      there.add(pad.index);
      const now = pad.buttons.map((button) => button.pressed);
      const before = this.#held.get(pad.index);
      if (before?.id === pad.id) {
        now.forEach((down, button) => down && before.buttons[button] === false && pressed.push({ pad, button }));
      }
      this.#held.set(pad.index, { id: pad.id, buttons: now });
    }
    for (const index of this.#held.keys()) if (!there.has(index)) this.#held.delete(index);
    return pressed;
  }

  /** Begin anew: whatever is held now does nothing. */
  forget() {
    this.#held.clear();
  }
}
