// Figures and words for a person. SI units in, millimetres and amperes out.

export const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
export const fixed = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]*$)/, ""); // no minus before nothing
export const millimetres = (value, digits = 2) => (isNumber(value) ? `${fixed(value * 1e3, digits)} mm` : "none");
export const micronewtons = (value) => (isNumber(value) ? `${fixed(value * 1e6, Math.abs(value) < 1e-5 ? 2 : 0)} µN` : "none");
export const speedText = (value) => (isNumber(value) ? `${(value * 1e3).toFixed(1)} mm/s` : "none");
export const seconds = (value) => (isNumber(value) ? `${value.toFixed(value < 9.95 ? 1 : 0)} s` : "never");
export const length = (vector) => (Array.isArray(vector) ? Math.hypot(vector[0], vector[1]) : null);
export const capital = (text) => (text ? text[0].toUpperCase() + text.slice(1) : text);
export const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;

// Least clearance over the nodes [m], null where neither wall nor shape is near any.
export function leastClearance(margins) {
  const near = (margins?.clearance ?? []).filter(isNumber);
  return margins?.valid && near.length ? Math.min(...near) : null;
}
