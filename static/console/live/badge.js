// The look of a session's state: colour by its tone, shape by its meaning.

/** Show `state_is` of a snapshot on the element of class "state"; null means that nothing is known. */
export function badge(element, is) {
  element.dataset.tone = is?.tone ?? "neutral";
  element.toggleAttribute("data-away", is?.connected === false);
  element.toggleAttribute("data-preparing", Boolean(is?.preparing));
}
