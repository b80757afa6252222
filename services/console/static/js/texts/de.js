// German texts; see en.js.

export default {
};
