'use strict';
// A click on the head of a column sorts by it: up, down, and as it was.
const digits = '⁰¹²³⁴⁵⁶⁷⁸⁹';
function number(text) {
  // "< 0.01", "below 1 %", "−0.3 ± 0.1", "8×10⁻¹¹", "1,234": the first number of a cell.
  const found = text.replaceAll('−', '-')
    .match(/^(?:[<>≤≥( ]|[a-z]+ )*(-?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?)/);
  const [, minus, raised] = text.match(/×10(⁻?)([⁰¹²³⁴-⁹]+)/) ?? ['', '', ''];
  const power = [...raised].reduce((sum, digit) => 10 * sum + digits.indexOf(digit), 0);
  return found ? Number(found[1].replaceAll(',', '')) * 10 ** (minus ? -power : power) : NaN;
}
for (const table of document.querySelectorAll('table')) {
  const heads = [...(table.tHead?.rows[0].cells ?? [])];
  // Rows that belong together are a body, moved as a whole; under a heading they stay.
  const whole = table.tBodies.length > 1 && !table.querySelector('[scope=rowgroup]');
  const lots = whole ? [[table, [...table.tBodies]]] : [...table.tBodies].map(
    body => [body, [...body.rows].filter(row => row.cells.length === heads.length)]);
  if (!lots.some(([, parts]) => parts.length > 1)) continue;
  const text = (part, column) => (part.rows?.[0] ?? part).cells[column].textContent.trim();
  heads.forEach((head, column) => {
    const button = document.createElement('button');
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener('click', () => {
      const way = {ascending: 'descending', descending: null}[head.ariaSort ?? 'none'];
      const sign = way === 'descending' ? -1 : 1;
      heads.forEach(other => { other.ariaSort = null; });
      head.ariaSort = way === undefined ? 'ascending' : way;
      for (const [place, parts] of lots) {
        const keyed = parts.map(part => [part, text(part, column), number(text(part, column))]);
        const numbers = keyed.some(([, , n]) => !isNaN(n))
          && keyed.every(([, words, n]) => !isNaN(n) || !/\d/.test(words));
        const order = ([, a, x], [, b, y]) => numbers
          ? isNaN(x) - isNaN(y) || sign * (x - y || 0)
          : sign * a.localeCompare(b, 'en', {numeric: true});
        if (head.ariaSort) keyed.sort(order);
        place.append(...keyed.map(([part]) => part));
      }
    });
  });
}
// What scrolls sideways can be reached with the keyboard.
const reach = new ResizeObserver(seen => seen.forEach(({target}) => {
  if (target.scrollWidth > target.clientWidth) target.tabIndex = 0;
  else target.removeAttribute('tabindex');
}));
document.querySelectorAll('.scroll, .frame, .equation, .table-wrapper, pre')
  .forEach(box => reach.observe(box));
